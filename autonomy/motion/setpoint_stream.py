"""From a planned motion to setpoint datagrams: its next 400 ms, every 50 ms, with a lease.

A motion is a function of time.  A datagram carries a window of it, so that the controller can interpolate and a late
planner does not reach the valves.  Before its start and past its end a motion stands still, so a hold is a window of
one pose with ``final`` set.  A motion that has stopped on its path is a hold, too: a planner that plans for longer
than the lease does not cause a controller stop.
"""

from __future__ import annotations

from typing import Final, Protocol

from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, SpoolKnot, SpoolTest
from can_dbc.messages.datagrams import encode

PERIOD_NS: Final = 50_000_000
HORIZON_KNOT_COUNT: Final = 8

Axes = tuple[float, ...]


class Motion(Protocol):
    """A joint motion over time."""

    @property
    def duration_s(self) -> float:
        """Time of its end, at rest."""

    def at(self, time_s: float) -> tuple[Axes, Axes]:
        """Return positions and velocities [rad, m; per second] in ``Joint`` order at any time, at rest outside."""


class SetpointStream:
    """Numbers and encodes the crane setpoints of one planner.

    The sequence starts at the monotonic time in ms, so that the datagrams of a restarted planner are not replays.
    """

    def __init__(self, profile_hash: int, lease_ns: int, key: bytes | None = None) -> None:
        self._profile_hash = profile_hash
        self._lease_ns = lease_ns
        self._key = key
        self._sequence: int | None = None
        self._due_ns = 0

    def due(self, now_ns: int) -> bool:
        """Tell whether to send a datagram now; if so, the next is due ``PERIOD_NS`` after this one was."""
        if now_ns < self._due_ns:
            return False
        on_time = self._due_ns > now_ns - PERIOD_NS // 2
        self._due_ns = (self._due_ns if on_time else now_ns) + PERIOD_NS
        return True

    def datagram(self, now_ns: int, motion: Motion, time_s: float, grapple: GrappleCommand, rate: float = 1.0) -> bytes:
        """Encode the datagram with the window of ``motion`` that starts now at its ``time_s``; ``rate`` is its seconds
        per second.
        """
        knots = []
        for index in range(HORIZON_KNOT_COUNT + 1):
            after_ns = index * PERIOD_NS
            position, velocity = motion.at(time_s + rate * after_ns * 1e-9)
            knots.append(Knot(after_ns, position, tuple(rate * v for v in velocity)))
        end_s = time_s + rate * HORIZON_KNOT_COUNT * PERIOD_NS * 1e-9
        setpoint = CraneSetpoint(
            self._next(now_ns),
            self._profile_hash,
            now_ns,
            self._lease_ns,
            grapple,
            rate == 0.0 or end_s >= motion.duration_s,
            tuple(knots),
        )
        return encode(setpoint, self._key)

    def spool(self, now_ns: int, function: int, knots: tuple[SpoolKnot, ...]) -> bytes:
        """Encode the datagram with a stretch of a spool program, from now on."""
        test = SpoolTest(self._next(now_ns), self._profile_hash, now_ns, self._lease_ns, function, knots)
        return encode(test, self._key)

    def _next(self, now_ns: int) -> int:
        self._sequence = now_ns // 1_000_000 if self._sequence is None else self._sequence + 1
        return self._sequence & 0xFFFF_FFFF
