"""The evaluator: observes the plant's ground truth and reports what happened to every log and to the machine.

It reads the physics only, never a bus or an encoder.  The bunk is evaluated in the crane's base frame, because a
carrier moves it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from sim.geometry import IDENTITY, Vector
from sim.hydraulics.layout import PA_PER_BAR
from sim.mechanics.crane import FLEX_JOINTS
from sim.wood.bunk import to_bunk
from sim.wood.logs import LogState
from sim.world import STEP_S, World

LIFTED_M: Final = 0.5
LEFT_GROUND_M: Final = 0.05
REST_M_S: Final = 0.01
REST_S: Final = 0.3
EVERY_STEPS: Final = 4
SIDE_TOLERANCE_M: Final = 0.02


@dataclass(frozen=True, slots=True)
class LogEvaluation:
    """One log.  ``lifted``: the crane raised it by more than LIFTED_M; ``left_ground``: its clearance grew by more than
    LEFT_GROUND_M.  ``in_bunk``: its middle is over the bunk, both ends are between the stakes, on the floor or on logs;
    ``released``: the crane does not touch it.  ``max_grip_n``: largest sum of the jaws' normal forces on it.
    """

    lifted: bool
    in_bunk: bool
    released: bool
    at_rest: bool
    left_ground: bool
    max_speed_m_s: float
    max_grip_n: float

    @property
    def done(self) -> bool:
        return self.in_bunk and self.released and self.at_rest


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The run so far.  ``success``: every log is done.  Energy is hydraulic, from the pump.

    ``tip_m`` is the true position of the hanger pin, ``rigid_tip_m`` its position on a stiff column, both in the
    crane's base frame; ``sag_m`` is their distance.  ``tip_margin_m``: least distance of a carrier's centre of pressure
    from the edge of its wheels' contacts, None on a fixed machine.  ``max_foot_moment_nm``: largest overturning moment
    that the column brings into the crane's foot.
    """

    logs: tuple[LogEvaluation, ...]
    success: bool
    loaded: int
    max_penetration_m: float
    max_log_speed_m_s: float
    energy_j: float
    peak_pressure_bar: float
    time_s: float
    tip_m: Vector
    rigid_tip_m: Vector
    sag_m: float
    max_sag_m: float
    tip_margin_m: float | None
    max_foot_moment_nm: float
    max_grip_n: float
    max_load_kg: float


class Evaluator:
    """Call ``watch`` once per physics step; ``evaluate`` at any time."""

    def __init__(self, world: World) -> None:
        self._w = world
        logs = world.log_bodies.states()
        n = len(logs)
        self._lay_m = [self._clearance(log) for log in logs]
        self._lifted, self._left, self._rest_s = [False] * n, [False] * n, [0.0] * n
        self._speed, self._grip = [0.0] * n, [0.0] * n
        self._steps = 0
        self._sag = self._foot = self._load = 0.0
        self._margin = math.inf
        self._machine()

    def watch(self) -> None:
        """Record what happens; evaluates every fourth step."""
        self._steps += 1
        if self._steps % EVERY_STEPS:
            return
        w = self._w
        touched, grip = w.touched(), w.grip_n
        for i, log in enumerate(w.log_bodies.states()):
            v = log.speed_m_s
            self._speed[i], self._grip[i] = max(self._speed[i], v), max(self._grip[i], grip[i])
            self._rest_s[i] = self._rest_s[i] + EVERY_STEPS * STEP_S if v < REST_M_S else 0.0
            if touched[i] and not (self._lifted[i] and self._left[i]):
                x, y, z = log.position_m
                self._lifted[i] |= z > w.terrain.height(x, y) + LIFTED_M
                self._left[i] |= self._clearance(log) > self._lay_m[i] + LEFT_GROUND_M
        self._machine()

    def _machine(self) -> None:
        w = self._w
        self._sag = max(self._sag, math.dist(w.tip(), w.rigid_tip()))
        self._foot = max(self._foot, math.hypot(*w.column.torques([w.q[j] for j in FLEX_JOINTS], (0.0, 0.0))))
        self._load = max(self._load, w.load_kg())
        if w.carrier is not None:
            self._margin = min(self._margin, w.carrier.tip_margin_m)

    def _clearance(self, log: LogState) -> float:
        """Compute the air under the lowest point of the log's ends and middle [m]."""
        height, fall = self._w.terrain.height, log.taper_m_m * log.length_m / 2
        places = zip((log.position_m, *log.ends_m), (0.0, fall, -fall), strict=True)
        return min(p[2] - (log.diameter_m + d) / 2 - height(p[0], p[1]) for p, d in places)

    def evaluate(self) -> Evaluation:
        """Return the evaluation up to now."""
        w = self._w
        inward = w.client.invertTransform(*w.base_pose())
        logs = tuple(
            LogEvaluation(
                lifted=self._lifted[i],
                in_bunk=self._in_bunk(
                    log, [w.client.multiplyTransforms(*inward, p, IDENTITY)[0] for p in (log.position_m, *log.ends_m)]
                ),
                released=not touched,
                at_rest=self._rest_s[i] >= REST_S,
                left_ground=self._left[i],
                max_speed_m_s=self._speed[i],
                max_grip_n=self._grip[i],
            )
            for i, (log, touched) in enumerate(zip(w.log_bodies.states(), w.touched(), strict=True))
        )
        tip, rigid = w.tip(), w.rigid_tip()
        return Evaluation(
            logs=logs,
            success=all(v.done for v in logs),
            loaded=sum(v.done for v in logs),
            max_penetration_m=w.max_penetration_m,
            max_log_speed_m_s=max(self._speed, default=0.0),
            energy_j=w.hydraulics.energy_j,
            peak_pressure_bar=w.hydraulics.peak_pa / PA_PER_BAR,
            time_s=self._steps * STEP_S,
            tip_m=tip,
            rigid_tip_m=rigid,
            sag_m=math.dist(tip, rigid),
            max_sag_m=self._sag,
            tip_margin_m=None if w.carrier is None else self._margin,
            max_foot_moment_nm=self._foot,
            max_grip_n=max(self._grip, default=0.0),
            max_load_kg=self._load,
        )

    def _in_bunk(self, log: LogState, in_base: list[Vector]) -> bool:
        b = self._w.profile.bunk
        (x, y, z), *ends = (to_bunk(b, p) for p in in_base)
        side = b.width_m / 2 + SIDE_TOLERANCE_M
        low, high = b.floor_z_m + log.diameter_m / 2 - 0.02, b.floor_z_m + b.stake_height_m
        between = all(abs(end[1]) <= side and low - 0.05 <= end[2] <= high for end in ends)
        return abs(x) <= b.length_m / 2 and abs(y) <= side and low <= z <= high and between
