"""What an observer of the buses and reports knows: when the machine reacted, why, and when every valve was neutral.

Nothing here looks into controller, guard or plant.  Mode and reason of a tick are those to which the recorded tick
replays (`timberhand replay`); commands, node states and the guard's verdict are frames on the buses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from can_dbc.dbc.codec import FrameRefused, MessageCodec
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from can_dbc.messages.vehicle import VehicleReport
from controller.tick import Outputs
from hil.wire.core import WireCore
from hil.wire.inprocess import InProcessBus
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.faults import FAULTS
from machine.status.modes import Mode
from machine.status.reasons import Reaction, pack
from sim.plant_faults import database

_ARMED: Final = 0xA
_SPOOL_MODE: Final = 2
_AT_REST: Final = (0, 3, 4)
"""ValveFbA.State: neutral, pilot off, fault."""
_WATCHED: Final = {
    "crane": ("ValveCmdA", "ValveCmdB", "ValveFbA", "GuardStat"),
    "machine": ("VehCmd", "VehStat"),
}
NAMES: Final = {Reaction.DEGRADE: "D", Reaction.HOLD: "H", Reaction.RAMP: "R1", Reaction.CUT: "R0"}
_OPERATING: Final = (Mode.ARMED, Mode.ACTIVE)


class Evidence:
    """Watches from `begin` on; times are in ms after it."""

    def __init__(self, cores: Sequence[WireCore], profile: Profile) -> None:
        self._buses = [InProcessBus(core, "evidence") for core in cores]
        self._codecs: dict[int, MessageCodec] = {}
        for name, messages in _WATCHED.items():
            if name == "crane" or profile.machine_bus:
                self._codecs |= {(c := database(name).message(m)).key: c for m in messages}
        self._begin_ns: int | None = None
        self._drives = False
        self._state: dict[str, Any] = {}
        self.timeline: list[tuple[float, str]] = []
        """Changes, in ms after the injection."""
        self.reached: dict[str, float] = {}
        """First time of each reaction (D, H, R1, R0)."""
        self.reason = ""
        self.refused_ms: float | None = None
        self.neutral_ms: float | None = None
        """Since when all functions are neutral by the buses; None while one is not."""
        self.frames = 0
        """Watched frames since the injection."""
        self._mode = -1
        self._refused: tuple[int, int] = (0, 0)
        self._counted = [0, 0]
        self._reason = 0

    def begin(self, now_ns: int, drives: bool) -> None:
        """Note the begin of the injection."""
        self._begin_ns, self._drives = now_ns, drives
        self._refused = (self._counted[0], self._counted[1])

    def slice(self, now_ns: int) -> None:
        """Read the buses after a slice."""
        frames: list[Frame] = []
        for bus in self._buses:
            bus.drain(frames)
        if self._begin_ns is None:
            return
        for frame in frames:
            codec = self._codecs.get(frame.key)
            if codec is not None:
                self._take(codec, frame)
        neutral = self._neutral()
        if not neutral:
            self.neutral_ms = None
        elif self.neutral_ms is None:
            self.neutral_ms = self._ms(now_ns)
            self._note(now_ns, "all functions neutral")

    def outputs(self, outputs: Outputs, now_ns: int) -> None:
        """Evaluate the outputs of a tick, as the recorded tick replays to them."""
        mode, reason = outputs.mode, outputs.reason
        if self._begin_ns is not None:
            reaction = FAULTS[reason].reaction
            # A stop that becomes harder for another reason counts: a PLC tells of its supply before the button.
            harder = mode is Mode.FAULT and self._mode == Mode.STOP and reason != self._reason
            stopped = (mode in (Mode.STOP, Mode.FAULT) and self._mode in _OPERATING) or harder
            slowed = mode in _OPERATING and reaction is Reaction.DEGRADE and reason != self._reason
            if stopped or slowed:
                self.reached.setdefault(NAMES.get(reaction, "H"), self._ms(now_ns))
                self.reason = self.reason or reason.name
            if mode != self._mode or (reason != self._reason and reason):
                self._note(now_ns, f"{mode.name}: {describe(pack(reason, outputs.detail))}")
        self._mode, self._reason = mode, reason

    def report(self, report: StateReport) -> None:
        """Evaluate a report of the controller."""
        self._counted[0] = report.refused
        self._refusal(report.stamp_ns, report.refusal)

    def vehicle(self, report: VehicleReport) -> None:
        """Evaluate a report of the vehicle."""
        self._counted[1] = report.refused
        self._refusal(report.stamp_ns, report.refusal)

    def _refusal(self, now_ns: int, refusal: int) -> None:
        if self._begin_ns is not None and self.refused_ms is None and tuple(self._counted) != self._refused:
            self.refused_ms = self._ms(now_ns)
            self._note(now_ns, f"refused: {describe(refusal)}")

    def _take(self, codec: MessageCodec, frame: Frame) -> None:
        try:
            values = codec.named(codec.receive(frame.data))
        except FrameRefused:
            return
        self.frames += 1
        before = self._state.get(codec.name, {})
        self._state[codec.name] = values
        watched = {"GuardStat": "Verdict", "ValveFbA": "State", "ValveCmdB": "ArmKey"}.get(codec.name)
        if watched and before and before.get(watched) != values.get(watched):
            self._note(frame.stamp_ns, f"{codec.name}.{watched} {before.get(watched)} to {values.get(watched)}")

    def _neutral(self) -> bool:
        a, b, node = (self._state.get(name) for name in ("ValveCmdA", "ValveCmdB", "ValveFbA"))
        spools = ("Slew", "Lift", "Tilt", "Ext")
        commanded = (
            a is None
            or b is None
            or (
                b.get("ArmKey") == _ARMED
                and (
                    (a.get("Mode") == _SPOOL_MODE and any(a.get(s) for s in spools))
                    or bool(b.get("Rot"))
                    or (bool(b.get("Grapple")) and b.get("GrappleMode") in (1, 2))
                )
            )
        )
        crane = not commanded or (node is not None and node.get("State") in _AT_REST)
        if not self._drives:
            return crane
        command, vehicle = self._state.get("VehCmd"), self._state.get("VehStat")
        stands = command is not None and (command.get("ArmKey") != _ARMED or bool(command.get("Brake")))
        return crane and (stands or (vehicle is not None and vehicle.get("Brake") == 1))

    def _ms(self, now_ns: int) -> float:
        return round((now_ns - (self._begin_ns or 0)) * 1e-6, 3)

    def _note(self, now_ns: int, text: str) -> None:
        if self._begin_ns is not None and len(self.timeline) < 40 and math.isfinite(now_ns):
            self.timeline.append((self._ms(now_ns), text))
