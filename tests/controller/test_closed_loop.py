"""The closed loop of the whole controller on a small plant with dead time, lag and dead-band."""

import msgspec
import pytest

from controller.config import Settings
from controller.laws.valve_map import ValveMap
from machine.loading.profile_file import profile_hash
from machine.profile import SPEED_HEADROOM_SHARE
from machine.status.modes import Mode
from tests.controller.bench import SETTINGS, SPECS, Bench
from tests.controller.smooth_motion import GOALS, drive

SLEW = SPECS[0]
TOTAL_S = 16.0


@pytest.mark.parametrize("kind", ["pd", "sliding_mode", pytest.param("super_twisting", marks=pytest.mark.long)])
def test_smooth_motion_of_all_joints_is_tracked(kind):
    """Profile of the 2026 test-bed (docs/reference/machines.md section 1.6), planner at 20 Hz, slow enough for the
    pump.
    """
    joints = {
        name: msgspec.structs.replace(s, law=msgspec.structs.replace(s.law, kind=kind))
        for name, s in SETTINGS.profile.joints.items()
    }
    profile = msgspec.structs.replace(SETTINGS.profile, joints=joints)
    bench = Bench(Settings(profile, profile_hash(profile), profile.rate_hz)).armed()
    worst = [0.0] * 5
    start = list(bench.q)
    for _ in drive(bench, TOTAL_S, TOTAL_S + 3.0):
        reference = bench.controller.reference_position
        worst = [max(w, abs(q - r)) for w, q, r in zip(worst, bench.q, reference, strict=True)]
        assert bench.controller.crane.governor.behind_ns == 0
    assert max(worst[:4]) < 0.004 and worst[4] < 0.01, worst
    for q, p, d, spec in zip(bench.q, start, GOALS, SPECS, strict=True):
        assert abs(q - p - d) <= 2.0 * spec.law.stop_band
    bench.run(60)
    assert bench.mode is Mode.ARMED


def test_valves_are_shut_at_rest():
    bench = Bench().armed()
    for _ in drive(bench, 8.0, 10.0):
        pass
    opened = 0
    for k in range(800):
        bench.tick([bench.hold()] if k % 10 == 0 else ())
        opened += not bench.neutral and any(bench.commands_a[s] for s in ("Slew", "Lift", "Tilt", "Ext"))
    assert opened <= 0.05 * 800


def test_half_speed_slows_the_trajectory():
    bench = Bench().active(speed=0.13)
    bench.dropped.add("PressA")
    bench.run(25)
    bench.drive(0, 0.13, 30)
    for _ in range(12):
        planned = bench.controller.crane.governor.planned(bench.now_ns)[1][0]
        bench.drive(0, min(planned + 0.03, 0.33), 10)
    assert bench.controller.supervisor.half_speed
    limit = ValveMap(SLEW.valve).spool_pct(0.5 * SPEED_HEADROOM_SHARE * SLEW.speed_limit)
    assert bench.commands_a["Slew"] <= limit + 0.05
    assert bench.controller.crane.governor.rate < 0.8
