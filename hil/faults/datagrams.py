"""What can be wrong with a planner's datagrams on their way to the controller (docs/reference/safety.md, 24 to 28, 45).

Each fault is a function of the datagrams of one tick.  Values are changed in a decoded message, which is encoded again:
checksum and form are right, unless they are the fault.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from random import Random

from can_dbc.messages.crane import CraneSetpoint, Knot, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import Datagram, decode, encode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.vehicle import DriveSetpoint
from hil.faults.order import Order
from hil.faults.table import FaultError

Effect = Callable[[int, list[bytes]], list[bytes]]
"""Time [ns] and the datagrams sent to those that arrive."""
_FAR_UNITS = 20.0
_STEP_UNITS = 0.4
_TOO_FAST = 8.0


def effect_of(order: Order, key: bytes | None = None) -> Effect:
    """The effect of a planner fault; ``key`` authenticates datagrams that are made anew.

    Raises:
        FaultError: the fault is none of datagrams.
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
    raise FaultError("fault.not-a-datagram", f"{order.fault} is no fault of a planner's datagrams")


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
    """Crane: every joint of every knot; carrier: the articulation, or the latitude of the waypoint."""
    if isinstance(m, CraneSetpoint):
        return replace(m, knots=tuple(Knot(k.after_ns, tuple(map(change, k.position)), k.velocity) for k in m.knots))
    h1, h2, h3, h4 = m.heights_m
    return replace(m, heights_m=(change(h1), h2, h3, h4))


def _too_fast(m: CraneSetpoint | DriveSetpoint) -> Datagram:
    if isinstance(m, CraneSetpoint):
        return replace(m, knots=tuple(Knot(k.after_ns, k.position, (_TOO_FAST,) * len(k.velocity)) for k in m.knots))
    return replace(m, speed_m_s=_TOO_FAST)


def _replayed() -> Effect:
    kept: list[bytes] = []

    def effect(now_ns: int, sent: list[bytes]) -> list[bytes]:
        if not kept:
            kept.extend(sent)
            return sent
        return kept[:1] if sent else []

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
    """One of the ways in which a datagram arrives damaged."""
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
    """ARM and RESET of an operator where only a planner may speak."""

    def effect(now_ns: int, sent: list[bytes]) -> list[bytes]:
        out = list(sent)
        for data in sent:
            message = decode(data, key)
            action = random.choice((OperatorAction.ARM, OperatorAction.RESET))
            out.append(encode(OperatorCommand(message.sequence, message.profile_hash, now_ns, action), key))
        return out

    return effect
