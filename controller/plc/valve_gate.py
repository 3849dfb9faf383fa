"""The controller's commands and the guard's enable, received from crane0 and turned into a command for the PLC.

Pure, and safe by absence like every valve node: a command that moves needs ValveCmdA and B with the arm key, the
guard's enable, SYNC, and the PLC's measurements, all fresh, and no command late by its number; in role REFERENCES also
the three reference frames.  After a loss while armed, and when a conversation with the PLC begins, it stays neutral
until the controller has disarmed.  A command beyond the PLC's limits is refused, never clamped.
"""

from __future__ import annotations

from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame
from can_dbc.plc import map as plc
from can_dbc.plc.map import N_AXES, N_JOINTS, Bounds, Command, Feedback, Grapple, MapError, Mode, Role, State
from can_dbc.protocols.punctuality import Punctuality
from controller.bus_io import ARM_KEY, MessageState, age_out
from machine.joints import JOINTS
from machine.profile import SPEED_HEADROOM_SHARE, Profile, joint
from machine.status.modes import Mode as ControllerMode

SYNC_NS: Final = 15_000_000
RESET_NS: Final = 200_000_000
_MODE_SPOOL: Final = 2
_SAFE_STATE_DEGRADED: Final = 1
_REFERENCES: Final = ("JointRefA", "JointRefB", "JointRefC")


class ExitCode:
    """ValveFbB.ExitCode (ISO 11783-7 reasons): why the node does not follow its command."""

    OK, SAFETY_STOP, GUARD_MISSING, COMMAND_TIMEOUT, OUT_OF_RANGE, NOT_ARMED, FUNCTION_FAULT = 0, 2, 4, 5, 6, 8, 9


class ValveGate:
    """Receives crane0; `command` is the next command for the PLC, ``exit`` why it is neutral."""

    def __init__(self, profile: Profile, role: Role, database: Database) -> None:
        self._role = role
        specs = [joint(profile, j) for j in JOINTS]
        self._bounds = (
            Bounds.valves()
            if role is Role.VALVES
            else Bounds.references([(s.lower, s.upper, SPEED_HEADROOM_SHARE * s.speed_limit) for s in specs])
        )
        names = ["ValveCmdA", "ValveCmdB", "GuardStat", "CtrlStatus"]
        names += _REFERENCES if role is Role.REFERENCES else ()
        states = [MessageState(database.message(name), bit) for bit, name in enumerate(names)]
        self._a, self._b, self._guard, self._status, *self._references = states
        self._states = tuple(states)
        self._by_key = {state.codec.key: state for state in states}
        period_ns = 1_000_000_000 // profile.rate_hz
        self._punctuality = {s.codec.key: Punctuality(period_ns, s.timeout_ns) for s in (self._a, self._b)}
        self._axes = [self._place(s.valve.signal) for s in specs]
        self._commanded = [*self._axes, (self._b, "Grapple"), (self._b, "GrappleMode")]
        self._places = [self._reference(j.name.capitalize()) for j in JOINTS] if self._references else []
        self._sync_ns = -SYNC_NS
        self._armed = False
        self._locked: int = ExitCode.NOT_ARMED
        self._reset_until_ns = 0
        self.refused = 0
        self.exit = ExitCode.NOT_ARMED

    def _place(self, signal: str) -> tuple[MessageState, str]:
        return (self._a if signal in self._a.codec.index else self._b), signal

    def _reference(self, name: str) -> tuple[MessageState, str]:
        return next(state for state in self._references if name in state.codec.index), name

    def receive(self, frame: Frame, now_ns: int) -> None:
        """Use a frame of crane0; other messages are ignored, and a command that comes too late ends its stream."""
        state = self._by_key.get(frame.key)
        if state is None:
            return
        refused = state.refused
        state.receive(frame, now_ns)
        if state.refused != refused:
            return
        stream = self._punctuality.get(frame.key)
        if stream is not None and stream.late(frame.data[1] & 0x0F, frame.stamp_ns):
            state.forget()
        elif state is self._b and state.get("ArmKey") != ARM_KEY:
            self._locked = 0

    def require_disarm(self) -> None:
        """Stay neutral until the controller has disarmed: a conversation with the PLC begins."""
        self._locked = self._locked or ExitCode.NOT_ARMED

    def sync(self, now_ns: int) -> None:
        """Note a SYNC."""
        self._sync_ns = now_ns

    @property
    def locked(self) -> bool:
        """Whether the controller must disarm first: an input was lost while armed, or a conversation began."""
        return self._locked != 0

    @property
    def counter(self) -> int:
        """E2E counter of the newest good ValveCmdA, 0 when it is stale."""
        return self._a.get("Counter") or 0

    def command(self, now_ns: int, feedback: Feedback | None, sampling: bool) -> Command:
        """Compute the command for the PLC now; ``sampling``: the PLC has measured the joints lately."""
        age_out(self._states, now_ns)
        missing = self._missing(now_ns) or (ExitCode.OK if sampling else ExitCode.FUNCTION_FAULT)
        if missing and self._armed:
            self._locked = missing
        armed = self._b.get("ArmKey") == ARM_KEY
        self._armed = not missing and not self._locked and armed
        self.exit = self._locked or missing or (ExitCode.OK if armed else ExitCode.NOT_ARMED)
        if not self._armed:
            return Command(reset=self._wants_reset(now_ns, feedback))
        command = self._wanted()
        try:
            self._bounds.check(command)
        except MapError:
            self.refused += 1
            self._armed, self._locked = False, ExitCode.OUT_OF_RANGE
            self.exit = ExitCode.OUT_OF_RANGE
            return Command()
        return command

    def _missing(self, now_ns: int) -> int:
        """Find what prevents passing a command on, as an exit code; 0 when nothing does."""
        needed = (self._a, self._b, *self._references)
        if any(state.values is None for state in needed) or now_ns - self._sync_ns > SYNC_NS:
            return ExitCode.COMMAND_TIMEOUT
        if self._guard.get("Enable") != ARM_KEY:
            return ExitCode.GUARD_MISSING
        commanded = [state.get(signal) for state, signal in self._commanded]
        if self._a.get("Mode") not in (0, _MODE_SPOOL) or None in commanded:
            return ExitCode.OUT_OF_RANGE
        return 0

    def _wanted(self) -> Command:
        """Build the controller's command; a reference that is not available means that nothing may move."""
        b, spare = self._b, (0.0,) * (N_AXES - N_JOINTS)
        mode, reference, rate = Mode.NEUTRAL, (0.0,) * N_AXES, (0.0,) * N_AXES
        if self._a.get("Mode") == _MODE_SPOOL and self._role is Role.VALVES:
            mode = Mode.VALVES
            reference = tuple(state.get(signal) / 100.0 for state, signal in self._axes) + spare
        elif self._a.get("Mode") == _MODE_SPOOL:
            positions = [state.get(name) for state, name in self._places]
            rates = [state.get(f"{name}Rate") for state, name in self._places]
            if None not in positions and None not in rates:
                mode, reference, rate = Mode.REFERENCES, (*positions, *spare), (*rates, *spare)
        return Command(
            mode=mode,
            armed=True,
            reference=reference,
            rate=rate,
            grapple=Grapple(b.get("GrappleMode")),
            grapple_pct=min(100, round(abs(b.get("Grapple")))),
            max_speed_pct=50 if self._status.get("SafeState") == _SAFE_STATE_DEGRADED else 100,
        )

    def _wants_reset(self, now_ns: int, feedback: Feedback | None) -> bool:
        """Give a pulse while the PLC is latched and the controller is not, because an operator has reset the latter.

        A reset moves nothing; a human must still arm through the controller.
        """
        acknowledged = self._status.get("Mode") in (ControllerMode.BOOT, ControllerMode.STANDBY)
        latched = feedback is not None and (feedback.state is State.SAFE or feedback.fault != 0)
        if latched and acknowledged and now_ns >= self._reset_until_ns + RESET_NS:
            self._reset_until_ns = now_ns + RESET_NS
        return latched and now_ns < self._reset_until_ns


def state_of(feedback: Feedback, gate: ValveGate) -> int:
    """Return ValveFbA.State: 0 neutral, 1 active, 3 pilot off, 4 fault."""
    if gate.locked:
        return 4
    return {State.EXECUTE: 1, State.SAFE: 3}.get(feedback.state, 0)


def fault_bits(feedback: Feedback) -> int:
    """Encode PlcStatus.FaultBits: one bit per fault of the map, the last one for every fault from 16 on."""
    return 0 if feedback.fault == plc.Fault.NONE else 1 << min(feedback.fault, 16) - 1
