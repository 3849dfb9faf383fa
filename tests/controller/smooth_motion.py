"""A planner that moves all joints together, on a smooth profile of seventh order."""

from machine.status.modes import Mode

GOALS = (0.8, 0.35, 0.6, 0.5, 1.2)
"""Displacement of every joint [rad, m]."""


def drive(bench, total_s, seconds):
    """Run a planner that plans all joints together; yields after each tick."""
    start, origin_ns = list(bench.q), bench.now_ns

    def plan(t_s):
        x = min(max(t_s / total_s, 0.0), 1.0)
        s = 35 * x**4 - 84 * x**5 + 70 * x**6 - 20 * x**7
        ds = (140 * x**3 - 420 * x**4 + 420 * x**5 - 140 * x**6) / total_s
        return [p + d * s for p, d in zip(start, GOALS, strict=True)], [d * ds for d in GOALS]

    for k in range(int(seconds * 200)):
        datagrams = []
        if k % 10 == 0:
            t_s = (bench.now_ns - origin_ns) * 1e-9
            datagrams = [
                bench.setpoint([(50 * i, *plan(t_s + 0.05 * i)) for i in range(9)], final=t_s + 0.4 >= total_s)
            ]
        bench.tick(datagrams)
        assert bench.mode is Mode.ACTIVE, (bench.reason, k)
        yield start
