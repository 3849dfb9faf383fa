"""The valve node (PLC, 10h): receives ValveCmdA/B and sets spool commands; without valid commands it is neutral.

The spools follow only while ValveCmdA, ValveCmdB (E2E valid, ArmKey 0xA) and GuardStat (Enable 0xA) are at most
50 ms old, no command is late by its number (`can_dbc.protocols.punctuality`), SYNC is at most three cycles old and the
pilot supply is on.  Lost while active: ramp to neutral in 60 ms, state FAULT until a fresh frame disarms; 300 ms
without commands: pilot off.  The grapple never opens on a loss.  A disarm is neutral at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from can_dbc.dbc.codec import Database
from can_dbc.protocols.punctuality import Punctuality
from machine.crane_nodes import CraneNode
from sim.nodes import Outbox
from sim.nodes.device import Device
from sim.nodes.messages import ARM_KEY, MS, PeriodicTimer, ProtectedInput, ProtectedMessage

COMMAND_NS = GUARD_NS = 50 * MS
SYNC_NS = 15 * MS
RAMP_NS = 60 * MS  # with 15 ms until SYNC counts as lost: neutral within 100 ms of a loss
PILOT_NS = 300 * MS
CYCLE_NS = 5 * MS
SLOW_NS = 20 * MS
END_BAR = 150.0  # pressure above this, while the pump pushes: the grapple cylinder is at its end or on a log
MODE_SPOOL = 2
CYCLE_US = 400  # reported as the PLC's longest cycle
HOLD_PCT = -20.0  # a held grapple gets a small closing flow, which maintains its pressure
FUNCTIONS = ("slew", "lift", "tilt", "ext", "rot", "grapple")
NO_AXIS = 15


class ValveState(IntEnum):
    """ValveFbA.State."""

    NEUTRAL = 0
    ACTIVE = 1
    RAMP = 2
    PILOT_OFF = 3
    FAULT = 4


class ExitCode(IntEnum):
    """ValveFbB.ExitCode (ISO 11783-7 reasons)."""

    OK = 0
    SAFETY_STOP = 2
    GUARD_MISSING = 4
    COMMAND_TIMEOUT = 5
    OUT_OF_RANGE = 6
    NOT_ARMED = 8


class GrappleState(IntEnum):
    """GrappleStat.State."""

    UNKNOWN = 0
    OPEN = 1
    OPENING = 2
    CLOSING = 3
    CLOSED = 4
    HOLDING = 5


@dataclass(slots=True)
class ValveInputs:
    """Readings of the node's own inputs.

    ``spools`` are -1..1 in FUNCTIONS order; the grapple's sensors are None where none is fitted.
    """

    spools: tuple[float, ...] = (0.0,) * 6
    flow_limited: bool = False
    opening: float | None = 1.0
    clamp_bar: float = 0.0
    release_bar: float = 0.0
    load_kg: float = 0.0
    rot_deg: float | None = 0.0


class ValveNode(Device):
    """``outputs_pct`` are the present spool commands, in FUNCTIONS order; ``sense`` reads the node's inputs.

    ``command_ns`` is the period of the commands.
    """

    def __init__(
        self,
        database: Database,
        outbox: Outbox,
        pilot_on: Callable[[], bool],
        sense: Callable[[], ValveInputs],
        cycle_ns: int = CYCLE_NS,
        command_ns: int = CYCLE_NS,
    ) -> None:
        super().__init__(CraneNode.VALVES, outbox)
        self._pilot_on, self._sense = pilot_on, sense
        self._a, self._b = (
            ProtectedInput(database, name, Punctuality(command_ns, COMMAND_NS)) for name in ("ValveCmdA", "ValveCmdB")
        )
        self._guard = ProtectedInput(database, "GuardStat")
        self._inputs = {i.key: i for i in (self._a, self._b, self._guard)}
        self._fb_a, self._fb_b, self._grapple_stat, self._plc = (
            ProtectedMessage(database, n) for n in ("ValveFbA", "ValveFbB", "GrappleStat", "PlcStatus")
        )
        self._fast, self._slow = PeriodicTimer(cycle_ns), PeriodicTimer(SLOW_NS, phase_ns=MS)
        self._watchdog = 0
        self._grapple = GrappleState.UNKNOWN
        self.restart()

    def restart(self) -> None:
        for i in self._inputs.values():
            i.reset()
        self.valve_state, self.exit = ValveState.NEUTRAL, ExitCode.NOT_ARMED
        self.outputs_pct = [0.0] * len(FUNCTIONS)
        self._ramp_from = list(self.outputs_pct)
        self._lost_ns: int | None = None
        self._sync_ns: int | None = None
        self._locked: ExitCode | None = None

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        """Accept a command or guard frame; others and invalid ones are ignored."""
        source = self._inputs.get(key)
        if source is None or not source.accept(data, now_ns):
            return
        if source is self._b and self._b.get("ArmKey") != ARM_KEY:
            self._locked = None

    def sync(self, now_ns: int) -> None:
        """Record that a SYNC was received."""
        self._sync_ns = now_ns

    def decide(self, now_ns: int) -> None:
        """Set ``outputs_pct``, ``valve_state`` and ``exit`` for this physics step."""
        missing = self._missing_condition(now_ns)
        if missing is not None and self.valve_state is ValveState.ACTIVE:
            self._locked, self._lost_ns, self._ramp_from = missing, now_ns, list(self.outputs_pct)
            self._ramp_from[-1] = 0.0  # the grapple's valve closes at once and holds
        outputs_pct = [0.0] * len(FUNCTIONS)
        armed = self._b.get("ArmKey") == ARM_KEY
        if missing is ExitCode.SAFETY_STOP or (missing is not None and not self._commands_fresh(now_ns, PILOT_NS)):
            self.valve_state, self.exit = ValveState.PILOT_OFF, missing
        elif self._locked is not None:
            self.exit = self._locked
            remaining_share = 1.0 - (now_ns - (self._lost_ns or 0)) / RAMP_NS
            self.valve_state = ValveState.RAMP if remaining_share > 0.0 else ValveState.FAULT
            outputs_pct = [max(0.0, remaining_share) * u for u in self._ramp_from]
        elif missing is not None or not armed:
            self.valve_state, self.exit = ValveState.NEUTRAL, missing or ExitCode.NOT_ARMED
        else:
            self.valve_state, self.exit = ValveState.ACTIVE, ExitCode.OK
            outputs_pct = self._commands()
        self.outputs_pct = outputs_pct

    def _commands_fresh(self, now_ns: int, limit_ns: int) -> bool:
        return self._a.fresh(now_ns, limit_ns) and self._b.fresh(now_ns, limit_ns)

    def _missing_condition(self, now_ns: int) -> ExitCode | None:
        """Find the first condition that is not met, or None."""
        if not self._pilot_on():
            return ExitCode.SAFETY_STOP
        synchronous = self._sync_ns is not None and now_ns - self._sync_ns <= SYNC_NS
        punctual = not (self._a.late or self._b.late)
        if not self._commands_fresh(now_ns, COMMAND_NS) or not synchronous or not punctual:
            return ExitCode.COMMAND_TIMEOUT
        if not self._guard.fresh(now_ns, GUARD_NS) or self._guard.get("Enable") != ARM_KEY:
            return ExitCode.GUARD_MISSING
        return None

    def _commands(self) -> list[float]:
        a, b = self._a, self._b
        out = [0.0] * len(FUNCTIONS)
        mode = a.get("Mode")
        if mode == MODE_SPOOL:
            out[:5] = [a.get("Slew"), a.get("Lift"), a.get("Tilt"), a.get("Ext"), b.get("Rot")]
        elif mode != 0:
            self.exit = ExitCode.OUT_OF_RANGE  # this node closes no velocity loop
        flow = abs(b.get("Grapple"))
        match b.get("GrappleMode"):
            case 1:
                out[5] = flow
            case 2:
                out[5] = -flow
            case 3:
                out[5] = HOLD_PCT
        return out

    def cycle(self, now_ns: int) -> None:
        fast, slow = self._fast.due(now_ns), self._slow.due(now_ns)
        if not (fast or slow):
            return
        m = self._sense()
        if fast:
            pct = [100.0 * s for s in m.spools]
            self.outbox.append(self._fb_a.frame(self.valve_state, *pct[:4]))
            limit = int(m.flow_limited)
            self.outbox.append(self._fb_b.frame(NO_AXIS, pct[4], pct[5], 0.0, self.exit, self._a.counter, limit))
        if slow:
            self._grapple = self._grapple_state(m)
            opening = None if m.opening is None else 100.0 * m.opening
            self.outbox.append(self._grapple_stat.frame(self._grapple, opening, m.clamp_bar, m.load_kg, m.rot_deg))
            self._watchdog = (self._watchdog + 1) & 0xFF
            run = 2 if self.valve_state is ValveState.ACTIVE else 1
            self.outbox.append(self._plc.frame(run, self._watchdog, CYCLE_US, 0))

    def _grapple_state(self, m: ValveInputs) -> GrappleState:
        """Judge by the opening where it is measured, else by the pressures at the ends."""
        command = self.outputs_pct[5]
        if m.opening is None:
            opened, closed = m.release_bar > END_BAR, m.clamp_bar > END_BAR
        else:
            opened, closed = m.opening > 0.98, m.opening < 0.02
        if command > 0.0:
            return GrappleState.OPEN if opened else GrappleState.OPENING
        if command == HOLD_PCT:
            return GrappleState.HOLDING
        if command < 0.0:
            return GrappleState.CLOSED if closed else GrappleState.CLOSING
        if m.opening is None:
            return self._grapple  # nothing pushes: the state is unchanged
        return GrappleState.OPEN if opened else GrappleState.CLOSED if closed else GrappleState.HOLDING
