"""Carries out orders on a lockstep run: a `hil.harness.lockstep.Disturbance`.

``attach`` hangs it on a run; `order` adds orders at any time.  The same orders, seeds and run give the same bytes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from random import Random
from typing import Final

from can_dbc.messages.crane import CraneSetpoint, Knot, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import Datagram, decode, encode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.vehicle import DriveSetpoint
from hil.faults.table import FAULTS, Edge, Order
from hil.faults.wire_faults import wire_fault
from hil.harness.lockstep import START_NS, Lockstep
from hil.plc import BridgedPlant
from hil.wire.faults import FOREVER_NS
from runtime.errors import InputRefused
from sim.errors import PlantError
from sim.plant_faults import PlantFault, begin

# -- What can be wrong with a planner's datagrams on their way to the controller (docs/reference/safety.md, 24 to
# 28, 45).
#
# Each fault is a function of the datagrams of one tick.  Values are changed in a decoded message, which is encoded
# again: checksum and form are right, unless they are the fault.


Effect = Callable[[int, list[bytes]], list[bytes]]
"""Time [ns] and the datagrams sent to those that arrive."""
_FAR_UNITS = 20.0
_STEP_UNITS = 0.4
_TOO_FAST = 8.0


def effect_of(order: Order, key: bytes | None = None) -> Effect:
    """Return the effect of a planner fault; ``key`` authenticates datagrams that are made anew.

    Raises:
        InputRefused: the fault is none of datagrams.
    """
    random, size_ns = Random(order.seed), round(order.sized() * 1e6) if math.isfinite(order.sized()) else 0
    match order.fault:
        case "planner-off":
            return lambda now_ns, sent: []
        case "planner-nan":
            bad = random.choice((math.nan, math.inf, -math.inf))
            return _changed(lambda m: _with_position(m, lambda q: bad), key)
        case "planner-range":
            return _changed(lambda m: _with_position(m, lambda q: q + _FAR_UNITS), key)
        case "planner-speed":
            return _changed(_too_fast, key)
        case "planner-jump":
            step = random.choice((-1.0, 1.0)) * _STEP_UNITS
            return _changed(lambda m: _with_position(m, lambda q: q + step), key)
        case "planner-future":
            return _changed(lambda m: replace(m, stamp_ns=m.stamp_ns + size_ns), key)
        case "planner-replay":
            return _replayed()
        case "planner-delayed":
            return _delayed(size_ns)
        case "planner-garbage":
            return lambda now_ns, sent: [_damaged(data, random) for data in sent]
        case "planner-arms":
            return _forged(random, key)
    raise InputRefused("fault.not-a-datagram", f"{order.fault} is no fault of a planner's datagrams")


def _changed(change: Callable[[CraneSetpoint | DriveSetpoint], Datagram], key: bytes | None) -> Effect:
    def effect(now_ns: int, sent: list[bytes]) -> list[bytes]:
        out = []
        for data in sent:
            try:
                message = decode(data, key)
            except DatagramRefused:
                message = None
            setpoint = isinstance(message, CraneSetpoint | DriveSetpoint)
            out.append(encode(change(message), key) if setpoint else data)  # type: ignore[arg-type]
        return out

    return effect


def _with_position(m: CraneSetpoint | DriveSetpoint, change: Callable[[float], float]) -> Datagram:
    """Change every joint of every knot of a crane's setpoint, or the first height of a carrier's."""
    if isinstance(m, CraneSetpoint):
        return replace(m, knots=tuple(Knot(k.after_ns, tuple(map(change, k.position)), k.velocity) for k in m.knots))
    h1, h2, h3, h4 = m.heights_m
    return replace(m, heights_m=(change(h1), h2, h3, h4))


def _too_fast(m: CraneSetpoint | DriveSetpoint) -> Datagram:
    if isinstance(m, CraneSetpoint):
        return replace(m, knots=tuple(Knot(k.after_ns, k.position, (_TOO_FAST,) * len(k.velocity)) for k in m.knots))
    return replace(m, speed_m_s=_TOO_FAST)


def _replayed() -> Effect:
    recorded_datagrams: list[bytes] = []

    def effect(now_ns: int, sent: list[bytes]) -> list[bytes]:
        if not recorded_datagrams:
            recorded_datagrams.extend(sent)
            return sent
        return recorded_datagrams[:1] if sent else []

    return effect


def _delayed(delay_ns: int) -> Effect:
    waiting: deque[tuple[int, bytes]] = deque()

    def effect(now_ns: int, sent: list[bytes]) -> list[bytes]:
        waiting.extend((now_ns + delay_ns, data) for data in sent)
        out = []
        while waiting and waiting[0][0] <= now_ns:
            out.append(waiting.popleft()[1])
        return out

    return effect


def _damaged(data: bytes, random: Random) -> bytes:
    """Damage a datagram in one of the ways in which datagrams arrive damaged."""
    match random.randrange(4):
        case 0:
            return data[: random.randrange(len(data))]
        case 1:
            return data + random.randbytes(1 + random.randrange(64))
        case 2:
            return random.randbytes(len(data))
    at = random.randrange(len(data))
    return data[:at] + bytes((data[at] ^ 1 << random.randrange(8),)) + data[at + 1 :]


def _forged(random: Random, key: bytes | None) -> Effect:
    """Add ARM and RESET of an operator where only a planner may speak."""

    def effect(now_ns: int, sent: list[bytes]) -> list[bytes]:
        out = list(sent)
        for data in sent:
            message = decode(data, key)
            action = random.choice((OperatorAction.ARM, OperatorAction.RESET))
            out.append(encode(OperatorCommand(message.sequence, message.profile_hash, now_ns, action), key))
        return out

    return effect


# -- Carries out orders on a lockstep run


_NOTHING: Final[Callable[[], None]] = lambda: None  # noqa: E731


@dataclass(slots=True)
class _Running:
    """An order with its times on the run's clock [ns], and what ends it once it has begun."""

    order: Order
    start_ns: int
    end_ns: int
    end: Callable[[], None] | None = None


class Injector:
    """All orders of one run."""

    def __init__(self, run: Lockstep, orders: Iterable[Order] = ()) -> None:
        self._run = run
        self._waiting: list[_Running] = []
        self._datagrams: list[Effect] = []
        self._stalled: dict[str, int] = {}
        self._late_since_ns: int | None = None
        self.begun: list[tuple[int, Order]] = []
        """What has begun, with its time."""
        run.disturbance = self
        for order in orders:
            self.order(order)

    def order(self, order: Order, start_ns: int | None = None) -> None:
        """Add an order; ``start_ns`` is a time on the run's clock instead of the order's own.

        Raises:
            InputRefused: this machine has no such fault or part.
        """
        start_ns = START_NS + round(order.at_s * 1e9) if start_ns is None else start_ns
        end_ns = start_ns + round(order.length_s * 1e9) if math.isfinite(order.length_s) else FOREVER_NS
        if FAULTS[order.fault].edge is Edge.BUS:  # the bus keeps exact times itself
            bus, fault = wire_fault(order, self._run.plant.profile, start_ns, end_ns)
            next(core for core in self._run.cores if core.name == bus).inject(fault)
            self.begun.append((start_ns, order))
            return
        self._waiting.append(_Running(order, start_ns, end_ns))

    def begin(self, now_ns: int) -> None:
        """Begin and end what is due before this slice."""
        if not self._waiting:
            return
        left = []
        for running in self._waiting:
            if running.end is None and now_ns >= running.start_ns:
                running.end = self._start(running, now_ns)
                self.begun.append((now_ns, running.order))
            if running.end is not None and now_ns >= running.end_ns:
                running.end()
            else:
                left.append(running)
        self._waiting = left

    def datagrams(self, now_ns: int, sent: list[bytes]) -> list[bytes]:
        """Return the datagrams that arrive."""
        for effect in self._datagrams:
            sent = effect(now_ns, sent)
        return sent

    def stalled(self, process: str, now_ns: int) -> bool:
        """Tell whether the process does not run now."""
        until_ns = self._stalled.get(process)
        if until_ns is None:
            return False
        if now_ns >= until_ns:
            del self._stalled[process]
            return False
        if process == "controller" and self._late_since_ns is None:
            self._late_since_ns = now_ns
        return True

    def late_ns(self, now_ns: int) -> int:
        """Tell how long ago the first tick was due that has not run."""
        since_ns, self._late_since_ns = self._late_since_ns, None
        return 0 if since_ns is None else now_ns - since_ns

    def _cut_link(self) -> Callable[[], None]:
        """Open the cable between bridge and PLC."""
        plant = self._run.plant
        if not isinstance(plant, BridgedPlant):
            raise InputRefused(
                "fault.no-plc", f"{plant.profile.name} has no PLC here; add --plc, or choose another fault"
            )
        plant.cut = True

        def end() -> None:
            plant.cut = False

        return end

    def _cut_operator(self) -> Callable[[], None]:
        """Cut the link of the operator."""
        operator = self._run.operator
        if not operator.watches:
            raise InputRefused("fault.not-watched", "no operator watches this run, so a cut link changes nothing here")
        operator.cut = True

        def end() -> None:
            operator.cut = False

        return end

    def _start(self, running: _Running, now_ns: int) -> Callable[[], None]:
        order = running.order
        match FAULTS[order.fault].edge:
            case Edge.PLANNER:
                effect = effect_of(order)
                self._datagrams.append(effect)
                return lambda: self._datagrams.remove(effect)
            case Edge.LINK:
                return self._cut_link()
            case Edge.OPERATOR:
                return self._cut_operator()
            case Edge.PROCESS:
                self._stalled[order.part] = running.end_ns if order.fault == "process-stuck" else FOREVER_NS
                return _NOTHING
        try:
            return begin(self._run.plant, PlantFault(order.fault, order.part, order.sized(), order.seed), now_ns)
        except PlantError as error:
            raise InputRefused(error.code, str(error)) from None
