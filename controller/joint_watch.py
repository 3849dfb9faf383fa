"""The crane's joints as they are watched: against their commands while armed, and for motion without one in every mode.

Inputs: the mode, the commands and spools of the last tick, the joints' estimates.  Output: reactions of the supervisor.

Armed (ARMED, ACTIVE): a joint that does not follow, runs away or goes backwards, and an encoder that stands still while
its joint is commanded to move, or drifts.  A joint in a spool test is only compared with the side of its command, since
the test measures what else can be expected.  A stop: a joint that does not come to rest.  Not armed: who moves the
machine? A valve that stuck open keeps it moving, and a person with a hand lever starts it again.  So a joint that has
not stood since the controller let go is a fault (`MOVES_WHILE_STOPPED`), and so is every motion in STOP, where nobody
has taken over; one that has stood and moves again in STANDBY or FAULT is shown and prevents arming, but does not cut
the pilot supply, because the levers need it: "move it back by hand lever" is the advice after POSITION_OUTSIDE.  A
machine that tells when a lever is out of neutral (EstopStat.Lever) has told who moves it.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Final

from controller.bus_io import Signal
from controller.crane.motion import Crane
from controller.estimation.joint_estimator import JointEstimator, SensedJoint
from controller.estimation.joint_monitors import (
    AGAINST_ELSEWHERE_S,
    AGAINST_S,
    LATE_DELAY_S,
    USUAL_SPEED,
    DriftMonitor,
    MotionMonitor,
    SlopeYield,
    StandstillMonitor,
)
from controller.estimation.valve_monitors import DirectionMonitor
from controller.supervisor import NO_JOINT, Supervisor
from controller.transitions import OPERATING
from machine.joints import N_JOINTS, Joint
from machine.profile import JointSpec
from machine.status.modes import Mode
from machine.status.reasons import Reason

FROZEN_S: Final = 0.1
"""An encoder that gives the same count for this long, ..."""
FROZEN_TEST_S: Final = 1.0
"""... in a spool test, where the joint may as well stand inside a dead-band that nobody knows, for this long, ..."""
FROZEN_S_AT_LIMIT: Final = 0.025
"""... while its joint should have moved as far as in this time at the speed limit, ..."""
FROZEN_NOISES: Final = 6.0
"""... and by this many times its noise and resolution, is frozen."""
LATE_FACTOR: Final = 1.2
"""The late bound of a dead time is at least this many times the profile's: a long one is measured less precisely."""
STOOD_S: Final = 1.0
"""A joint has stood when it has stayed in its place for this long."""
_NONE: Final = Reason.NONE
_RUNAWAY: Final = Reason.JOINT_RUNAWAY
_REVERSED: Final = Reason.JOINT_REVERSED
_BOOT: Final = Mode.BOOT
_LEVER: Final = Reason.LEVER_MOVED
_ROT: Final = int(Joint.ROT)
_SLEW: Final = int(Joint.SLEW)
_STOP: Final = Mode.STOP


class JointWatch:
    """All monitors of the crane's joints."""

    __slots__ = (
        "_crane",
        "_drift",
        "_estimators",
        "_frozen_ticks",
        "_frozen_travel",
        "_loop_outputs",
        "_monitors",
        "_period_s",
        "_sensed",
        "_signs",
        "_standstill",
        "_stood",
        "_tests",
        "_travel",
        "_was_armed",
        "_yield",
    )

    def __init__(
        self,
        specs: Sequence[JointSpec],
        period_s: float,
        crane: Crane,
        estimators: Sequence[JointEstimator],
        sensed: Sequence[SensedJoint | None],
        loop_outputs: Sequence[Signal] = (),
    ) -> None:
        """All sequences are in ``Joint`` order; ``sensed`` is None where a joint has no encoder, or one whose
        counts do not tell whether it is frozen.  ``loop_outputs``: openings of a PLC that closes the loops itself."""
        self._crane, self._estimators, self._sensed = crane, estimators, sensed
        self._loop_outputs = loop_outputs
        self._period_s = period_s
        later_s = [max(0.0, LATE_FACTOR * s.valve.delay_s - LATE_DELAY_S) for s in specs]
        against_s = AGAINST_ELSEWHERE_S if loop_outputs else AGAINST_S
        usual = list(zip(specs, USUAL_SPEED, strict=True))
        self._monitors = [
            MotionMonitor(s, period_s, later, against_s=against_s, least_speed=speed)
            for (s, speed), later in zip(usual, later_s, strict=True)
        ]
        self._tests = [DirectionMonitor(s, period_s) for s in specs]
        self._standstill = [StandstillMonitor(s, period_s, s.valve.delay_s, speed) for s, speed in usual]
        self._drift = [DriftMonitor(s, period_s, speed) for s, speed in usual]
        self._frozen_ticks = (round(FROZEN_S / period_s), round(FROZEN_TEST_S / period_s))
        self._yield = SlopeYield(period_s)
        self._signs = [s.valve.sign for s in specs]
        self._frozen_travel = [
            FROZEN_S_AT_LIMIT * s.speed_limit
            + (FROZEN_NOISES * (s.encoder.noise + s.encoder.unit_per_count) if s.encoder is not None else 0.0)
            for s in specs
        ]
        self._travel = array("d", [0.0] * N_JOINTS)
        self._stood = True
        self._was_armed = False

    def begin_session(self) -> None:
        """Forget what the joints did before an operator armed."""
        for j in range(N_JOINTS):
            self._monitors[j].reset()
            self._standstill[j].reset()
            self._drift[j].reset()
            self._tests[j].reset()
            self._travel[j] = 0.0

    def step(self, supervisor: Supervisor, carrier_moves: bool, now_ns: int) -> None:
        """Watch every joint once and react; after the supervisor has decided on everything else."""
        crane, estimators = self._crane, self._estimators
        armed = supervisor.mode in OPERATING
        loops = self._loop_outputs if armed else ()
        if self._was_armed and not armed:
            self._stood = False
        self._was_armed = armed
        from_outside = carrier_moves or crane.grapple.spool_pct != 0.0
        open_valves = 0
        for pct in crane.spools_pct:
            if pct != 0.0:
                open_valves += 1
        shaken = from_outside or open_valves > 0
        pressed, pushed = crane.pressed(now_ns), crane.slew_is_pushed()
        self._yield.step(pressed, crane.roll_rad, crane.pitch_rad)
        moving, stands = NO_JOINT, True
        for j in range(N_JOINTS):
            estimator, monitor, standstill = estimators[j], self._monitors[j], self._standstill[j]
            if not estimator.known or estimator.jumped or supervisor.mode is _BOOT:
                monitor.reset()
                standstill.reset()
                self._drift[j].reset()
                self._travel[j] = 0.0
                continue  # what an encoder did that jumped or was lost is no motion
            neutral = crane.spools_pct[j] == 0.0 and not (loops and loops[j].value())
            velocity = estimator.velocity
            yields = pushed if j == _SLEW else j == _ROT and (pressed or crane.grapple.at_work)
            reason = monitor.step(crane.commands[j], velocity, yields)
            tested = crane.spool_run.tested(j, now_ns)
            if tested:
                monitor.forgive()
                reason = _REVERSED if self._tests[j].step(self._signs[j] * crane.spools_pct[j], velocity) else _NONE
            else:
                self._tests[j].reset()
            # Tongs that close about logs or release them turn the rotator against its valve, and its law turns it
            # back: only a fast motion of it is a runaway, and none is drift.
            slack = self._yield.rad if j == _SLEW else 0.0
            if standstill.step(neutral, shaken, estimator.position, slack, pressed) and j != _ROT:
                reason = _RUNAWAY
            elif reason is _REVERSED and j == _ROT and crane.grapple.at_work:
                reason = _NONE
            if supervisor.mode in OPERATING:
                others = open_valves if crane.spools_pct[j] == 0.0 else open_valves - 1
                calm = not (from_outside or pressed) and others == 0
                self._judge_encoder(supervisor, j, neutral, calm, tested, reason, now_ns)
            else:
                stands = stands and standstill.quiet_s >= STOOD_S
                if reason is _RUNAWAY:
                    moving = j
        self._settle(supervisor, moving, stands, now_ns)

    def _judge_encoder(
        self, supervisor: Supervisor, j: int, neutral: bool, calm: bool, tested: bool, reason: Reason, now_ns: int
    ) -> None:
        """React to the finding about an armed joint, or to what its encoder shows besides."""
        monitor = self._monitors[j]
        expected = 0.0 if tested else monitor.expected_velocity
        drifts = j != _ROT and self._drift[j].step(neutral, expected, self._estimators[j].position, calm)
        frozen = self._frozen(j, monitor, tested)
        if reason is _RUNAWAY:
            supervisor.react_to(reason, j, now_ns)
        elif frozen:
            supervisor.react_to(Reason.ENCODER_FROZEN, j, now_ns)
        elif reason is not _NONE:
            supervisor.react_to(reason, j, now_ns)
        elif drifts:
            supervisor.react_to(Reason.ENCODER_DRIFT, j, now_ns)

    def _frozen(self, j: int, monitor: MotionMonitor, tested: bool) -> bool:
        """Tell whether the encoder stands still to the last count although its joint should have moved."""
        sensed = self._sensed[j]
        if sensed is None or not sensed.dithers or sensed.unchanged == 0:
            self._travel[j] = 0.0
            return False
        self._travel[j] += abs(monitor.expected_velocity) * self._period_s
        return sensed.unchanged >= self._frozen_ticks[tested] and self._travel[j] > self._frozen_travel[j]

    def shares(self, j: int) -> dict[str, float]:
        """Compute what was measured of a joint over what is a fault, 1 and more, by the fault."""
        reversed_, stuck, runaway = self._monitors[j].shares()
        shares = {"joint stuck": stuck, "joint too fast for its command": runaway}
        if not (j == _ROT and self._crane.grapple.at_work):
            shares["joint against its command"] = reversed_
        if j != _ROT:
            shares |= {
                "joint moves with its valve shut": self._standstill[j].share(),
                "encoder drifts": self._drift[j].share(),
            }
        sensed = self._sensed[j]
        if sensed is not None:
            unchanged = sensed.unchanged / self._frozen_ticks[0]
            shares["encoder frozen"] = min(unchanged, self._travel[j] / self._frozen_travel[j])
        return shares

    def _settle(self, supervisor: Supervisor, moving: int, stands: bool, now_ns: int) -> None:
        """Judge a motion while nothing is armed."""
        supervisor.moving_joint = NO_JOINT
        if supervisor.mode in OPERATING or supervisor.mode is _BOOT:
            return
        if supervisor.lever_moved:
            self._stood = True  # a person has taken over
        if moving == NO_JOINT:
            self._stood |= stands
        elif not self._stood or (supervisor.mode is _STOP and supervisor.reason is not _LEVER):
            self._stood = False  # a reset does not make it stand
            supervisor.latch_motion(moving, now_ns)
        else:
            supervisor.moving_joint = moving
