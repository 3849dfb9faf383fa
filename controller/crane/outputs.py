"""Frames that the controller sends on crane0: valve commands and SYNC every tick, status, heartbeat, references.

Inputs: spool commands in -100..100 %, grapple, mode and reason.  Outputs: ``(key, data)`` in send order.  SYNC is
returned apart, because it goes out later: it requests the sensors' samples for the next tick.  The arm key is set only
while the machine is armed; otherwise the frames still go out, with neutral values, so that silence always means a dead
controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from can_dbc.dbc.codec import Database, MessageCodec
from can_dbc.frame import RawFrame
from can_dbc.messages.crane import GrappleCommand
from can_dbc.protocols.canopen import NodeState, heartbeat_frame, next_sync, sync_frame
from controller.bus_io import ARM_KEY, PeriodicTimer, ProtectedMessage, safe_state
from machine.crane_nodes import CraneNode
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Profile, joint
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import ConfigError

STATUS_NS: Final = 20_000_000
HEARTBEAT_NS: Final = 100_000_000
_SPOOL: Final = 2
_NEUTRAL: Final = 0
_MAX_FLOW_PCT: Final = 100.0


def _ranges(profile: Profile, codec: MessageCodec) -> list[tuple[int, float, float, float]]:
    """List (joint, lowest, highest position, greatest speed) that a reference frame can carry; raises ConfigError."""
    ranges = []
    signals = {s.name: s for s in codec.signals}
    for j in JOINTS:
        name = j.name.capitalize()
        if name in signals:
            at, rate, spec = signals[name], signals[f"{name}Rate"], joint(profile, j)
            low, high, fastest = at.minimum or 0.0, at.maximum or 0.0, rate.maximum or 0.0
            if not (low <= spec.lower and spec.upper <= high and spec.speed_limit <= fastest):
                raise ConfigError(
                    "config.reference-range",
                    f"joints.{name.lower()}: {codec.name} carries only {low:g} to {high:g} at {fastest:g} per s; "
                    "reduce the joint's range or speed limit.",
                )
            ranges.append((int(j), low, high, fastest))
    return ranges


class CraneWriter:
    """Builds the frames of a tick in a list that the caller owns."""

    __slots__ = (
        "_a",
        "_b",
        "_booted",
        "_grapple",
        "_heartbeat",
        "_mode_at",
        "_references",
        "_spools",
        "_status",
        "_status_at",
        "_status_due",
        "_sync",
    )

    def __init__(self, database: Database, profile: Profile) -> None:
        codecs = [database.message(name) for name in ("ValveCmdA", "ValveCmdB", "CtrlStatus")]
        self._a, self._b, self._status = (ProtectedMessage(codec) for codec in codecs)
        index_a, index_b = codecs[0].index, codecs[1].index
        self._spools: list[tuple[ProtectedMessage, int]] = []
        for j in JOINTS:
            signal = joint(profile, j).valve.signal
            if signal not in index_a and signal not in index_b:
                raise ConfigError(
                    "config.valve-signal",
                    f"joints.{j.name.lower()}.valve.signal: no ValveCmd signal is called {signal}; "
                    "use a name of the DBC.",
                )
            self._spools.append((self._a, index_a[signal]) if signal in index_a else (self._b, index_b[signal]))
        referring = profile.plc is not None and profile.plc.role == "references"
        names = ("JointRefA", "JointRefB", "JointRefC") if referring else ()
        self._references = [(ProtectedMessage(c), _ranges(profile, c)) for c in map(database.message, names)]
        self._mode_at = index_a["Mode"]
        self._grapple = tuple(index_b[s] for s in ("ArmKey", "Grapple", "GrappleMode", "PumpReq", "MaxFlow"))
        self._status_at = tuple(
            codecs[2].index[s] for s in ("Mode", "SafeState", "Reason", "StaleMask", "LoopLate", "BusErr")
        )
        self._status_due, self._heartbeat = PeriodicTimer(STATUS_NS, 5_000_000), PeriodicTimer(HEARTBEAT_NS, 15_000_000)
        self._sync = 240
        self._booted = False

    def commands(
        self,
        spools_pct: Sequence[float],
        grapple_pct: float,
        grapple_mode: GrappleCommand,
        moving: bool,
        armed: bool,
        frames: list[RawFrame],
    ) -> None:
        """Append ValveCmdA and ValveCmdB; unless ``moving`` they are neutral whatever the spools are, except for
        HOLD.
        """
        for j in range(N_JOINTS):
            message, index = self._spools[j]
            message.values[index] = spools_pct[j] if moving else 0.0
        self._a.values[self._mode_at] = _SPOOL if moving else _NEUTRAL
        key, grapple, mode, pump, flow = self._grapple
        values = self._b.values
        values[key] = ARM_KEY if armed else 0
        values[grapple] = grapple_pct if moving else 0.0
        passed_on = moving or grapple_mode is GrappleCommand.HOLD
        values[mode] = grapple_mode if passed_on else GrappleCommand.NEUTRAL
        values[pump] = 1 if armed else 0
        values[flow] = _MAX_FLOW_PCT
        frames.append(self._a.frame())
        frames.append(self._b.frame())

    def references(
        self, position: Sequence[float], velocity: Sequence[float], moving: bool, frames: list[RawFrame]
    ) -> None:
        """Append the joint references for a PLC that closes the joint loops, if this machine has one.

        ``velocity`` is to be commanded now.  A value that is not available (not ``moving``, unknown, or outside the
        frame's range) means that nothing may move.
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
    ) -> RawFrame:
        """Encode CtrlStatus."""
        state = safe_state(mode, reason, half_speed)
        values = self._status.values
        contents = (mode, state, reason, stale_mask, max(late_ns, 0) * 1e-6, min(bus_errors, 255))
        for index, value in zip(self._status_at, contents, strict=True):
            values[index] = value
        return self._status.frame()

    def heartbeat_and_sync(self, now_ns: int, frames: list[RawFrame]) -> RawFrame:
        """Append the heartbeat when it is due; returns the SYNC that requests the samples of the next tick."""
        if self._heartbeat.due(now_ns):
            state = NodeState.OPERATIONAL if self._booted else NodeState.BOOT_UP
            self._booted = True
            frames.append(heartbeat_frame(CraneNode.CONTROLLER, state))
        self._sync = next_sync(self._sync)
        return sync_frame(self._sync)

    def status_due(self, now_ns: int) -> bool:
        """Tell whether CtrlStatus is due in this tick."""
        return self._status_due.due(now_ns)
