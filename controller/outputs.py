"""What the controller says on crane0: valve commands and SYNC every tick, status, heartbeat, NMT.

Inputs: spool commands in -100..100 %, grapple, mode and reason.  Outputs: ``(key, data)`` in send order, and SYNC
apart, because it goes out later: it asks the sensors for the next tick.  The arm key is given only while the
machine is armed; in every other case the frames still go out, with neutral values, so that silence always means a
dead controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.canopen import NodeState, Wire, heartbeat_frame, next_sync, sync_frame
from can_dbc.codec import Database, MessageCodec
from can_dbc.e2e import Sender
from can_dbc.setpoint import GrappleCommand
from controller.config import ConfigError
from machine.faults import FAULTS
from machine.joints import JOINTS, N_JOINTS
from machine.modes import Mode
from machine.profile import Profile, joint
from machine.reasons import Reaction, Reason

CONTROLLER_NODE: Final = 0x7E
ARM_KEY: Final = 0xA
STATUS_NS: Final = 20_000_000
HEARTBEAT_NS: Final = 100_000_000
_SPOOL, _NEUTRAL = 2, 0
_MAX_FLOW_PCT: Final = 100.0
_RUN, _DEGRADED, _CONTROLLED_STOP, _SAFE_STOP = range(4)


class Every:
    """Says when a period is over, without drift, at the nominal time of a tick: at the first call, and from then on
    ``apart_ns`` later than others of the same period, so that not everything falls into one tick.
    """

    __slots__ = ("_apart_ns", "_next_ns", "_period_ns")

    def __init__(self, period_ns: int, apart_ns: int = 0) -> None:
        self._period_ns = period_ns
        self._apart_ns = apart_ns
        self._next_ns = 0

    def due(self, now_ns: int) -> bool:
        """True once per period, and at the first call."""
        if now_ns < self._next_ns:
            return False
        if self._next_ns:
            self._next_ns = max(self._next_ns + self._period_ns, now_ns + self._period_ns // 2)
        else:
            self._next_ns = now_ns + self._period_ns + self._apart_ns
        return True


class Message:
    """A protected message with its value list, reused every time."""

    __slots__ = ("_encode", "_sender", "key", "values")

    def __init__(self, codec: MessageCodec) -> None:
        self.key = codec.key
        self.values: list[float | None] = [0.0] * len(codec.signals)
        self._encode = codec.encode
        self._sender = Sender(codec.data_ids or bytes(16))

    def frame(self) -> Wire:
        """The next frame with the present values."""
        return self.key, self._sender.protect(self._encode(*self.values))

    def carrying(self, *values: float | None) -> Wire:
        """The next frame with all the values that follow the E2E header; None is not available."""
        self.values[2:] = values
        return self.frame()


def _ranges(profile: Profile, codec: MessageCodec) -> list[tuple[int, float, float, float]]:
    """(joint, lowest and highest position, greatest speed) that a frame of references carries; raises ConfigError."""
    found = []
    signals = {s.name: s for s in codec.signals}
    for j in JOINTS:
        name = j.name.capitalize()
        if name in signals:
            at, rate, spec = signals[name], signals[f"{name}Rate"], joint(profile, j)
            low, high, fastest = at.minimum or 0.0, at.maximum or 0.0, rate.maximum or 0.0
            if not (low <= spec.lower and spec.upper <= high and spec.speed_limit <= fastest):
                raise ConfigError(
                    f"joints.{name.lower()}: {codec.name} carries {low:g} to {high:g} at {fastest:g} per s."
                )
            found.append((int(j), low, high, fastest))
    return found


def safe_state(mode: Mode, reason: Reason, half_speed: bool) -> int:
    """The safety state that `CtrlStatus` and `CtrlAlive` tell."""
    if mode is Mode.STOP:
        return _CONTROLLED_STOP
    if mode is Mode.FAULT:
        return _SAFE_STOP if FAULTS[reason].reaction is Reaction.CUT else _CONTROLLED_STOP
    return _DEGRADED if half_speed else _RUN


class Writer:
    """Builds the frames of a tick into a list that the caller owns."""

    __slots__ = (
        "_a", "_b", "_booted", "_grapple", "_heartbeat", "_mode_at", "_places", "_references", "_status", "_status_at",
        "_status_due", "_sync",
    )  # fmt: skip

    def __init__(self, database: Database, profile: Profile) -> None:
        codecs = [database.message(name) for name in ("ValveCmdA", "ValveCmdB", "CtrlStatus")]
        self._a, self._b, self._status = (Message(codec) for codec in codecs)
        index_a, index_b = codecs[0].index, codecs[1].index
        self._places: list[tuple[Message, int]] = []
        for j in JOINTS:
            signal = joint(profile, j).valve.signal
            if signal not in index_a and signal not in index_b:
                raise ConfigError(f"joints.{j.name.lower()}.valve.signal: no ValveCmd signal is called {signal}.")
            self._places.append((self._a, index_a[signal]) if signal in index_a else (self._b, index_b[signal]))
        wanted = profile.plc is not None and profile.plc.role == "references"
        names = ("JointRefA", "JointRefB", "JointRefC") if wanted else ()
        self._references = [(Message(c), _ranges(profile, c)) for c in map(database.message, names)]
        self._mode_at = index_a["Mode"]
        self._grapple = tuple(index_b[s] for s in ("ArmKey", "Grapple", "GrappleMode", "PumpReq", "MaxFlow"))
        self._status_at = tuple(
            codecs[2].index[s] for s in ("Mode", "SafeState", "Reason", "StaleMask", "LoopLate", "BusErr")
        )
        self._status_due, self._heartbeat = Every(STATUS_NS, 5_000_000), Every(HEARTBEAT_NS, 15_000_000)
        self._sync = 240
        self._booted = False

    def commands(
        self,
        spools_pct: Sequence[float],
        grapple_pct: float,
        grapple_mode: GrappleCommand,
        moving: bool,
        armed: bool,
        frames: list[Wire],
    ) -> None:
        """Appends ValveCmdA and ValveCmdB; not ``moving`` is neutral whatever the spools say, but for a HOLD."""
        for j in range(N_JOINTS):
            message, place = self._places[j]
            message.values[place] = spools_pct[j] if moving else 0.0
        self._a.values[self._mode_at] = _SPOOL if moving else _NEUTRAL
        key, grapple, mode, pump, flow = self._grapple
        values = self._b.values
        values[key] = ARM_KEY if armed else 0
        values[grapple] = grapple_pct if moving else 0.0
        kept = moving or grapple_mode is GrappleCommand.HOLD
        values[mode] = grapple_mode if kept else GrappleCommand.NEUTRAL
        values[pump] = 1 if armed else 0
        values[flow] = _MAX_FLOW_PCT
        frames.append(self._a.frame())
        frames.append(self._b.frame())

    def references(
        self, position: Sequence[float], velocity: Sequence[float], moving: bool, frames: list[Wire]
    ) -> None:
        """Appends the joint references for a PLC that closes the joint loops, if this machine has one.

        ``velocity`` is to be commanded now.  Not available (not ``moving``, unknown, or past what a frame can carry)
        means that nothing is to move.
        """
        for message, joints in self._references:
            values, at = message.values, 2
            for j, low, high, fastest in joints:
                known = moving and low <= position[j] <= high and -fastest <= velocity[j] <= fastest
                values[at] = position[j] if known else None
                values[at + 1] = velocity[j] if known else None
                at += 2
            frames.append(message.frame())

    def status(
        self, mode: Mode, reason: Reason, half_speed: bool, stale_mask: int, late_ns: int, bus_errors: int
    ) -> Wire:
        """CtrlStatus."""
        state = safe_state(mode, reason, half_speed)
        values = self._status.values
        contents = (mode, state, reason, stale_mask, max(late_ns, 0) * 1e-6, min(bus_errors, 255))
        for place, value in zip(self._status_at, contents, strict=True):
            values[place] = value
        return self._status.frame()

    def finish(self, now_ns: int, frames: list[Wire]) -> Wire:
        """Appends the heartbeat when it is due; returns the SYNC that asks the sensors for the next tick."""
        if self._heartbeat.due(now_ns):
            state = NodeState.OPERATIONAL if self._booted else NodeState.BOOT_UP
            self._booted = True
            frames.append(heartbeat_frame(CONTROLLER_NODE, state))
        self._sync = next_sync(self._sync)
        return sync_frame(self._sync)

    def status_due(self, now_ns: int) -> bool:
        """Whether CtrlStatus is to be sent in this tick."""
        return self._status_due.due(now_ns)
