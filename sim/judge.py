"""The judge: watches the plant's truth and says whether the job was done, for every log and for the run."""

from __future__ import annotations

from dataclasses import dataclass

from sim.logs import LogState, to_bunk
from sim.world import STEP_S, World

LIFTED_M = 0.5
REST_M_S = 0.01
REST_S = 0.3
EVERY_STEPS = 4
SIDE_TOLERANCE_M = 0.02


@dataclass(frozen=True, slots=True)
class LogVerdict:
    """One log.  ``in_bunk``: centre over the bunk, both ends between the stakes, on the floor or on logs."""

    lifted: bool
    in_bunk: bool
    released: bool
    at_rest: bool

    @property
    def done(self) -> bool:
        return self.in_bunk and self.released and self.at_rest


@dataclass(frozen=True, slots=True)
class Verdict:
    """The run so far.  ``success``: every log done.  Energy is hydraulic, from the pump."""

    logs: tuple[LogVerdict, ...]
    success: bool
    loaded: int
    max_penetration_m: float
    max_log_speed_m_s: float
    energy_j: float
    peak_pressure_bar: float
    time_s: float


class Judge:
    """``watch`` once per physics step; ``verdict`` at any time."""

    def __init__(self, world: World) -> None:
        self._w = world
        n = len(world.yard.logs)
        self._lifted, self._rest_s = [False] * n, [0.0] * n
        self._steps = 0
        self._fastest = 0.0

    def watch(self) -> None:
        """Take note of what happens; looks at every fourth step."""
        self._steps += 1
        if self._steps % EVERY_STEPS:
            return
        ground = self._w.profile.workspace.ground_z_m
        touched = self._w.touched()
        for i, log in enumerate(self._w.yard.states()):
            self._fastest = max(self._fastest, log.speed_m_s)
            if touched[i] and log.position_m[2] > ground + LIFTED_M:
                self._lifted[i] = True
            self._rest_s[i] = self._rest_s[i] + EVERY_STEPS * STEP_S if log.speed_m_s < REST_M_S else 0.0

    def verdict(self) -> Verdict:
        """Judgement at this moment."""
        w = self._w
        logs = tuple(
            LogVerdict(self._lifted[i], self._in_bunk(log), not touched, self._rest_s[i] >= REST_S)
            for i, (log, touched) in enumerate(zip(w.yard.states(), w.touched(), strict=True))
        )
        return Verdict(
            logs=logs,
            success=all(v.done for v in logs),
            loaded=sum(v.done for v in logs),
            max_penetration_m=w.max_penetration_m,
            max_log_speed_m_s=self._fastest,
            energy_j=w.hydraulics.energy_j,
            peak_pressure_bar=w.hydraulics.peak_pa / 1e5,
            time_s=self._steps * STEP_S,
        )

    def _in_bunk(self, log: LogState) -> bool:
        b = self._w.profile.bunk
        x, y, z = to_bunk(b, log.position_m)
        half = log.length_m / 2
        ends = [to_bunk(b, [p + s * half * a for p, a in zip(log.position_m, log.axis, strict=True)]) for s in (-1, 1)]
        side = b.width_m / 2 + SIDE_TOLERANCE_M
        low, high = b.floor_z_m + log.diameter_m / 2 - 0.02, b.floor_z_m + b.stake_height_m
        between = all(abs(end[1]) <= side and low - 0.05 <= end[2] <= high for end in ends)
        return abs(x) <= b.length_m / 2 and abs(y) <= side and low <= z <= high and between
