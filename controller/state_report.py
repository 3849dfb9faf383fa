"""The state report: 50 times a second the controller's mode, refusals, estimates and timing, in one datagram.

It only reads; nothing that it reports changes the state of a law.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from controller.bus_io import PeriodicTimer, Signal, or_nan
from controller.config import Settings
from controller.crane.inputs import CraneInputs
from controller.crane.motion import Crane
from controller.estimation.joint_estimator import JointEstimator
from controller.evidence import Evidence
from controller.requests import SetpointGate
from controller.supervisor import Supervisor
from machine.status.reasons import pack

REPORT_NS: Final = 20_000_000


class StateReporter:
    """Builds the reports; ``late_ns`` and ``tick_ns`` are the worst since the last one."""

    __slots__ = (
        "_crane",
        "_due",
        "_estimators",
        "_evidence",
        "_gate",
        "_inputs",
        "_mode_switch",
        "_sequence",
        "_settings",
        "_supervisor",
        "late_ns",
        "tick_ns",
    )

    def __init__(
        self,
        settings: Settings,
        supervisor: Supervisor,
        gate: SetpointGate,
        inputs: CraneInputs,
        crane: Crane,
        estimators: Sequence[JointEstimator],
        evidence: Evidence,
    ) -> None:
        self._settings, self._supervisor, self._gate = settings, supervisor, gate
        self._inputs, self._crane, self._estimators, self._evidence = inputs, crane, estimators, evidence
        self._mode_switch = Signal(inputs.estop, "ModeSwitch")
        self._due, self._sequence = PeriodicTimer(REPORT_NS), 0
        self.late_ns = self.tick_ns = 0

    def note_timing(self, late_ns: int, tick_ns: int) -> None:
        """Remember the worst lateness and duration of a tick until the next report."""
        self.late_ns = max(self.late_ns, late_ns)
        self.tick_ns = max(self.tick_ns, tick_ns)

    def report(self, stale_mask: int, missed_ticks: int, frames: int, now_ns: int) -> bytes | None:
        """A state report when one is due, else None; ``frames`` counts the frames received since the start."""
        if not self._due.due(now_ns):
            return None
        supervisor, gate, crane, estimators = self._supervisor, self._gate, self._crane, self._estimators
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        # Six by place, and tuples from lists: CPython 3.11 never takes a tuple of 20 (the names of all fields) or one
        # made from a generator from its free list again, and the heap would grow for half an hour.
        report = StateReport(
            self._sequence,
            self._settings.profile_hash,
            now_ns,
            supervisor.mode,
            crane.grapple.state,
            pack(supervisor.reason, supervisor.detail),
            setpoint_sequence=gate.sequence,
            refusal=pack(gate.refusal, gate.detail),
            refused=gate.refused,
            stale_mask=stale_mask,
            position=tuple([e.position for e in estimators]),
            velocity=tuple([e.velocity for e in estimators]),
            reference=tuple(crane.governor.position),
            opening_pct=crane.opening_pct(),
            clamp_bar=or_nan(self._inputs.grapple.get("ClampPress")),
            load_kg=crane.load_kg,
            tick_ns=self.tick_ns,
            late_ns=self.late_ns,
            missed_ticks=missed_ticks,
            frames_received=frames,
            since_ns=self._evidence.since_ns,
            numbers=self._evidence.numbers,
            operator_link=supervisor.operator_link.state(now_ns),
            mode_switch=self._mode_switch.value() or 0,
        )
        self.late_ns = self.tick_ns = 0
        return encode(report)
