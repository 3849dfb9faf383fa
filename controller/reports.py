"""The state report: what the controller says of itself 50 times a second, and how it knows the load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.setpoint import StateReport, encode
from controller.config import Settings
from controller.crane import Crane
from controller.estimator import JointEstimator
from controller.inputs import Received
from controller.load import LoadEstimate
from controller.message_state import known
from controller.outputs import Every
from controller.requests import Gate
from controller.supervisor import Supervisor
from machine.joints import Joint
from machine.reasons import pack

REPORT_NS: Final = 20_000_000


class Reports:
    """Builds the reports; ``late_ns`` and ``tick_ns`` are the worst since the last one."""

    __slots__ = (
        "_crane", "_due", "_estimators", "_gate", "_load", "_received", "_sequence", "_settings", "_supervisor",
        "late_ns", "tick_ns",
    )  # fmt: skip

    def __init__(
        self,
        settings: Settings,
        supervisor: Supervisor,
        gate: Gate,
        received: Received,
        crane: Crane,
        estimators: Sequence[JointEstimator],
    ) -> None:
        self._settings, self._supervisor, self._gate = settings, supervisor, gate
        self._received, self._crane, self._estimators = received, crane, estimators
        self._load = LoadEstimate(settings.profile)
        self._due, self._sequence = Every(REPORT_NS), 0
        self.late_ns = self.tick_ns = 0

    def measure(self, late_ns: int, tick_ns: int) -> None:
        """Lateness of this tick, and how long the one before took."""
        self.late_ns = max(self.late_ns, late_ns)
        self.tick_ns = max(self.tick_ns, tick_ns)

    def report(self, stale_mask: int, missed_ticks: int, frames: int, now_ns: int) -> bytes | None:
        """A state report when one is due; ``frames`` is how many were received since the start."""
        if not self._due.due(now_ns):
            return None
        supervisor, gate, crane, estimators = self._supervisor, self._gate, self._crane, self._estimators
        load_kg = self._load_kg()
        crane.grapple.weigh(load_kg, now_ns)
        self._sequence = (self._sequence + 1) & 0xFFFF_FFFF
        # Three by place, and tuples from lists: CPython 3.11 never takes a tuple of 20 (the names of all fields) or one
        # made from a generator from its free list again, and the heap would grow for half an hour.
        report = StateReport(
            self._sequence,
            self._settings.profile_hash,
            now_ns,
            mode=supervisor.mode,
            grapple_state=crane.grapple.state,
            reason=pack(supervisor.reason, supervisor.detail),
            setpoint_sequence=gate.sequence,
            refusal=pack(gate.refusal, gate.detail),
            refused=gate.refused,
            stale_mask=stale_mask,
            position=tuple([e.position for e in estimators]),
            velocity=tuple([e.velocity for e in estimators]),
            reference=tuple(crane.follower.reference),
            opening_pct=crane.opening_pct(),
            clamp_bar=known(self._received.grapple.get("ClampPress")),
            load_kg=load_kg,
            tick_ns=self.tick_ns,
            late_ns=self.late_ns,
            missed_ticks=missed_ticks,
            frames_received=frames,
        )
        self.late_ns = self.tick_ns = 0
        return encode(report, self._settings.key)

    def _load_kg(self) -> float:
        """By the load cell where there is one, else by the lift's pressures."""
        measured = self._received.grapple.get("Load")
        if measured is not None:
            return float(measured)
        lift, slot = self._estimators[Joint.LIFT], self._received.pressures[0]
        position = [e.position for e in self._estimators]
        return self._load.step(position, lift.velocity, slot.get("LiftA"), slot.get("LiftB"), REPORT_NS * 1e-9)
