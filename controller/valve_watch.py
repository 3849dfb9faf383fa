"""The crane's valves as they are watched while armed: spool against command, and joint against spool.

Inputs: the last tick's commands, the positions of the spools where a sensor measures them (ValveFbA and B), the joints'
estimates.  Output: reactions of the supervisor.  Together the two comparisons tell a valve from an encoder: a spool
that does not follow is the valve's fault, a joint that does not follow its spool the encoder's, the oil's, or that of
an obstacle.
Behind a PLC no sensor measures the spools: a joint is compared with the opening that the PLC reports for its valve, and
where the PLC only passes openings on, that opening with its command.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from controller.bus_io import Signal
from controller.crane.inputs import CraneInputs, spool_signals
from controller.crane.motion import Crane
from controller.estimation.joint_estimator import JointEstimator
from controller.estimation.joint_monitors import USUAL_SPEED
from controller.estimation.valve_monitors import (
    LONGEST_DELAY_S,
    SPEED_WINDOW_S,
    SpeedMonitor,
    SpoolMonitor,
    command_window_s,
)
from controller.supervisor import Supervisor
from controller.transitions import OPERATING
from machine.joints import N_JOINTS, Joint
from machine.profile import JointSpec, Plc
from machine.status.modes import Mode
from machine.status.reasons import Reason

_FOLLOWS: Final = 1
"""ValveFbA.State: active."""
_NONE: Final = Reason.NONE
_ACTIVE: Final = Mode.ACTIVE
_ROT: Final = int(Joint.ROT)
_SLEW: Final = int(Joint.SLEW)


def allowed_delay_s(spec: JointSpec) -> float:
    """Return the dead time to allow for; without an encoder no calibration has measured it."""
    return spec.valve.delay_s if spec.encoder is not None else max(spec.valve.delay_s, LONGEST_DELAY_S)


class ValveWatch:
    """The monitors of all spools and joints."""

    __slots__ = (
        "_crane",
        "_estimators",
        "_flow_limited",
        "_loops_elsewhere",
        "_measured",
        "_monitors",
        "_speeds",
        "_spools_sensed",
        "_state",
    )

    def __init__(
        self,
        specs: Sequence[JointSpec],
        period_s: float,
        plc: Plc | None,
        crane: Crane,
        inputs: CraneInputs,
        estimators: Sequence[JointEstimator],
    ) -> None:
        """Specs in ``Joint`` order; behind a ``plc`` a machine has no position sensors on its spools."""
        self._crane, self._estimators = crane, estimators
        self._state, self._flow_limited = Signal(inputs.valve_a, "State"), Signal(inputs.valve_b, "Limit")
        self._measured, self._spools_sensed = spool_signals(inputs), plc is None
        self._loops_elsewhere = plc is not None and plc.role == "references"
        self._monitors = [
            SpoolMonitor(min(s.valve.deadband_plus_pct, s.valve.deadband_minus_pct), period_s, allowed_delay_s(s))
            for s in specs
        ]
        self._speeds = [
            SpeedMonitor(
                s.valve, s.speed_limit, period_s, SPEED_WINDOW_S if plc is None else command_window_s(s.valve), least
            )
            for s, least in zip(specs, USUAL_SPEED, strict=True)
        ]

    def shares(self, j: int) -> dict[str, float]:
        """Compute what was measured of a valve and its joint over what is a fault, 1 and more, by the fault."""
        opened, shut, wrong = self._monitors[j].shares()
        fast, slow, stood = self._speeds[j].shares()
        return {
            "spool open": opened,
            "spool shut": shut,
            "spool wrong": wrong,
            "joint too fast for its valve": fast,
            "joint too slow for its valve": slow,
            "joint stands while its valve is open": stood,
        }

    def step(self, supervisor: Supervisor, now_ns: int) -> None:
        """Watch every valve once and react; after the supervisor has decided on everything else."""
        follows = supervisor.mode in OPERATING and self._state.value() == _FOLLOWS
        crane = self._crane
        if not follows:
            for j in range(N_JOINTS):
                self._monitors[j].follow(crane.spools_pct[j])
                self._speeds[j].reset()
            return
        moved_by_law = supervisor.mode is _ACTIVE and crane.leased and not crane.spool_run.running
        limited = self._flow_limited.value() == 1
        pressed, pushed = crane.pressed(now_ns), crane.slew_is_pushed()
        for j in range(N_JOINTS):
            spool_pct, expected = self._measured[j].value(), crane.commands[j]
            if spool_pct is not None:
                if not self._loops_elsewhere:
                    reason = self._monitors[j].step(crane.spools_pct[j], spool_pct, crane.spool_run.tested(j, now_ns))
                    if reason is not _NONE:
                        supervisor.react_to(reason, j, now_ns)
                expected = crane.law.valves[j].velocity(spool_pct)
            estimator = self._estimators[j]
            # Logs between the tongs turn or hold the rotator, whose spool alone tells; a test has its own limits.
            turned = j == _ROT and (self._spools_sensed or crane.grapple.at_work)
            if turned or not moved_by_law or limited or not estimator.known or estimator.jumped:
                self._speeds[j].reset()
                continue
            reason = self._speeds[j].step(expected, estimator.velocity, pressed, j == _SLEW and pushed)
            if reason is not _NONE:
                supervisor.react_to(reason, j, now_ns)
