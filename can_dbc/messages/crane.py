"""The crane's datagrams: setpoint, spool test, operator command and state report, with their bodies.

They travel in the envelope of `can_dbc.messages.envelope`; `can_dbc.messages.datagrams` encodes and decodes them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final, NamedTuple

from can_dbc.messages.envelope import Common, DatagramFault, DatagramRefused, finite

N_AXES: Final = 5
MAX_KNOTS: Final = 16
FULL_PCT: Final = 100.0

_CRANE: Final = struct.Struct("<IBBBB")
_KNOT: Final = struct.Struct(f"<I{2 * N_AXES}d")
_OPERATOR: Final = struct.Struct("<I")
_SPOOL: Final = struct.Struct("<IBB")
_SPOOL_KNOT: Final = struct.Struct("<Id")
_REPORT: Final = struct.Struct(f"<BBHIHHH{3 * N_AXES + 3}d4I")
_EVIDENCE: Final = struct.Struct("<Q3d")
"""Behind a report whose reason slowed or stopped the machine."""
_LINK: Final = struct.Struct("<B")
"""Behind everything else, once an operator watches."""
_LINK_AND_SWITCH: Final = struct.Struct("<BB")
"""In its place on a machine with a mode switch."""


class GrappleCommand(IntEnum):
    """Open-loop grapple command (paper A III-A); the numbers are those of ``ValveCmdB.GrappleMode``."""

    NEUTRAL = 0
    OPEN = 1
    CLOSE = 2
    HOLD = 3


_GRAPPLE_COMMANDS: Final = tuple(GrappleCommand)
"""By number: calling an enumeration costs the tick more than the rest of a setpoint's head."""


class OperatorAction(IntEnum):
    """Requests of an operator to the controller; each one is an edge, not a level."""

    ARM = 1
    DISARM = 2
    STOP = 3
    RESET = 4
    WATCH = 5
    """Heartbeat of a person who watches the machine; without the next one in time the machine holds."""
    WATCH_END = 6
    """The person ends the watch on purpose."""


WATCH_ACTIONS: Final = (OperatorAction.WATCH, OperatorAction.WATCH_END)
WATCH_PERIOD_NS: Final = 200_000_000
"""Period of the heartbeats: of the shortest limit that a profile allows, one may be lost."""


class LinkWatch(IntEnum):
    """Whether the link of an operator who watches is there (`controller.operator_link`)."""

    OFF = 0
    """Nobody watches."""
    WATCHED = 1
    LOST = 2


class ModeSwitch(IntEnum):
    """The operator's mode switch; the numbers are those of ``EstopStat.ModeSwitch``."""

    NOT_FITTED = 0
    """The machine has none, or it is not known yet."""
    IDLE = 1
    AUTO = 2
    FAULTY = 3


class Knot(NamedTuple):
    """Joint positions and velocities (rad, m; per second; ``Joint`` order) at ``after_ns`` past the stamp.

    A tuple, because a setpoint has up to 16 of them and the tick that accepts it makes them all.
    """

    after_ns: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CraneSetpoint:
    """A short joint trajectory with a lease: valid until ``stamp_ns + lease_ns``.

    ``final`` marks the last knot as the end of the motion: once it is reached, the end of the lease is no fault.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    lease_ns: int
    grapple: GrappleCommand
    final: bool
    knots: tuple[Knot, ...]


@dataclass(frozen=True, slots=True)
class SpoolKnot:
    """Command of one valve function [%, + moves the joint in its positive direction] at ``after_ns`` past the stamp."""

    after_ns: int
    percent: float


@dataclass(frozen=True, slots=True)
class SpoolTest:
    """A spool command for one function (a ``Joint`` number), to identify its valve; all others stay neutral.

    Linear between the knots, neutral after the last one.  Valid until ``stamp_ns + lease_ns``.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    lease_ns: int
    function: int
    knots: tuple[SpoolKnot, ...]


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """One request of an operator.

    ``profile_check``: the check of the profile's file that an ARM is meant for, 24 bits, as in ``GuardStat``; 0: not
    said.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    action: OperatorAction
    profile_check: int = 0


@dataclass(frozen=True, slots=True)
class StateReport:
    """State of the controller, 50 times per second.

    ``position``, ``velocity`` and ``reference`` are in ``Joint`` order; unknown values are NaN.  ``mode`` is
    a ``machine.status.modes.Mode``, ``reason`` the supervisor's number; ``refused`` counts setpoints refused since
    start, ``refusal`` is the last reason.  ``tick_ns`` is the longest tick, ``late_ns`` the worst lateness
    since the last report.

    While the reason is one that slows or stops the machine, ``since_ns`` is when it began, else 0, and ``numbers`` is
    its evidence: measured value, limit and one more (`machine.status.evidence`), NaN where there is none.
    ``operator_link`` is a `LinkWatch`, ``mode_switch`` a `ModeSwitch`.
    """

    sequence: int
    profile_hash: int
    stamp_ns: int
    mode: int
    grapple_state: int
    reason: int
    setpoint_sequence: int
    refusal: int
    refused: int
    stale_mask: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    reference: tuple[float, ...]
    opening_pct: float
    clamp_bar: float
    load_kg: float
    tick_ns: int
    late_ns: int
    missed_ticks: int
    frames_received: int
    since_ns: int = 0
    numbers: tuple[float, ...] = ()
    operator_link: int = LinkWatch.OFF
    mode_switch: int = ModeSwitch.NOT_FITTED


def crane_body(m: CraneSetpoint) -> bytes:
    """Encode the body of a crane setpoint; times are truncated to 1 us."""
    head = _CRANE.pack(m.lease_ns // 1000, m.grapple, int(m.final), len(m.knots), N_AXES)
    return head + b"".join(_KNOT.pack(k.after_ns // 1000, *k.position, *k.velocity) for k in m.knots)


def spool_body(m: SpoolTest) -> bytes:
    """Encode the body of a spool test; times are truncated to 1 us."""
    head = _SPOOL.pack(m.lease_ns // 1000, m.function, len(m.knots))
    return head + b"".join(_SPOOL_KNOT.pack(k.after_ns // 1000, k.percent) for k in m.knots)


def operator_body(m: OperatorCommand) -> bytes:
    """Encode the body of an operator command."""
    return _OPERATOR.pack(m.action | m.profile_check << 8)


def report_body(m: StateReport) -> bytes:
    """Encode the body of a state report; counters wrap at their width."""
    body = _REPORT.pack(
        m.mode,
        m.grapple_state,
        m.reason,
        m.setpoint_sequence,
        m.refusal,
        m.refused & 0xFFFF,
        m.stale_mask,
        *m.position,
        *m.velocity,
        *m.reference,
        m.opening_pct,
        m.clamp_bar,
        m.load_kg,
        m.tick_ns & 0xFFFFFFFF,
        m.late_ns & 0xFFFFFFFF,
        m.missed_ticks & 0xFFFFFFFF,
        m.frames_received & 0xFFFFFFFF,
    )
    if m.since_ns:
        body += _EVIDENCE.pack(m.since_ns, *m.numbers)
    if m.mode_switch:
        return body + _LINK_AND_SWITCH.pack(m.operator_link, m.mode_switch)
    return body + _LINK.pack(m.operator_link) if m.operator_link else body


def crane_from(common: Common, body: bytes) -> CraneSetpoint:
    lease_us, grapple, final, n_knots, axes = _CRANE.unpack_from(body)
    if len(body) != _CRANE.size + n_knots * _KNOT.size or axes != N_AXES:
        raise DatagramRefused(DatagramFault.LENGTH)
    if not 1 <= n_knots <= MAX_KNOTS or final > 1:
        raise DatagramRefused(DatagramFault.VALUE)
    if grapple >= len(_GRAPPLE_COMMANDS):
        raise DatagramRefused(DatagramFault.VALUE)
    knots: list[Knot] = []
    before_us = -1
    for i in range(n_knots):
        values: tuple[Any, ...] = _KNOT.unpack_from(body, _CRANE.size + i * _KNOT.size)
        finite(values)
        after_us = values[0]
        if after_us <= before_us:
            raise DatagramRefused(DatagramFault.VALUE)
        before_us = after_us
        # Knot(...) costs three times as much
        knots.append(tuple.__new__(Knot, (after_us * 1000, values[1 : N_AXES + 1], values[N_AXES + 1 :])))
    return CraneSetpoint(*common, lease_us * 1000, _GRAPPLE_COMMANDS[grapple], bool(final), tuple(knots))


def spool_from(common: Common, body: bytes) -> SpoolTest:
    lease_us, function, n_knots = _SPOOL.unpack_from(body)
    if len(body) != _SPOOL.size + n_knots * _SPOOL_KNOT.size:
        raise DatagramRefused(DatagramFault.LENGTH)
    if not 1 <= n_knots <= MAX_KNOTS or function >= N_AXES:
        raise DatagramRefused(DatagramFault.VALUE)
    knots: list[SpoolKnot] = []
    for i in range(n_knots):
        after_us, percent = _SPOOL_KNOT.unpack_from(body, _SPOOL.size + i * _SPOOL_KNOT.size)
        finite((percent,))
        if abs(percent) > FULL_PCT or (knots and after_us * 1000 <= knots[-1].after_ns):
            raise DatagramRefused(DatagramFault.VALUE)
        knots.append(SpoolKnot(after_us * 1000, percent))
    return SpoolTest(*common, lease_us * 1000, function, tuple(knots))


def operator_from(common: Common, body: bytes) -> OperatorCommand:
    """Decode an operator command; raises struct.error for a wrong length and ValueError for an unknown action."""
    (word,) = _OPERATOR.unpack(body)
    return OperatorCommand(*common, OperatorAction(word & 0xFF), word >> 8)


def report_from(common: Common, body: bytes) -> StateReport:
    """Decode a report, with or without evidence, link and switch; raises struct.error for a wrong length."""
    values = _REPORT.unpack(body[: _REPORT.size])
    more = body[_REPORT.size :]
    since_ns, link, switch = 0, 0, 0
    numbers: tuple[Any, ...] = ()
    if len(more) % _EVIDENCE.size == _LINK.size:
        more, link = more[: -_LINK.size], more[-1]
        if link not in (LinkWatch.WATCHED, LinkWatch.LOST):
            raise DatagramRefused(DatagramFault.LENGTH)
    elif len(more) % _EVIDENCE.size == _LINK_AND_SWITCH.size:
        more, link, switch = more[: -_LINK_AND_SWITCH.size], more[-2], more[-1]
        if link > LinkWatch.LOST or not ModeSwitch.IDLE <= switch <= ModeSwitch.FAULTY:
            raise DatagramRefused(DatagramFault.LENGTH)
    if more:
        since_ns, *measured = _EVIDENCE.unpack(more)
        numbers = tuple(measured)
    joints = values[7 : 7 + 3 * N_AXES]
    fields: list[Any] = [*common, *values[:7]]
    fields += [joints[:N_AXES], joints[N_AXES : 2 * N_AXES], joints[2 * N_AXES :]]
    fields += [*values[7 + 3 * N_AXES :], since_ns, numbers, link, switch]
    return StateReport(*fields)
