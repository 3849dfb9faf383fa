"""From a planned motion to setpoint datagrams: the next 400 ms of it, every 50 ms, with a lease.

A motion is a function of time; a datagram shows a window of it, so that the controller can interpolate and a
late planner does not reach the valves.  Before its start and past its end a motion stands still, so a hold is
nothing special: its window is one pose, and ``final`` is set.
"""

from __future__ import annotations

from typing import Final, Protocol

from can_dbc.setpoint import CraneSetpoint, GrappleCommand, Knot, encode

PERIOD_NS: Final = 50_000_000
HORIZON_KNOTS: Final = 8

Axes = tuple[float, ...]


class Motion(Protocol):
    """A joint motion over time."""

    @property
    def duration_s(self) -> float:
        """When it is at its end and at rest."""

    def at(self, time_s: float) -> tuple[Axes, Axes]:
        """Positions and velocities [rad, m; per second] in ``Joint`` order at any time, at rest outside."""


class SetpointStream:
    """Numbers and encodes the crane setpoints of one planner.

    The sequence starts at the monotonic time in ms: a planner that is started again is never taken for a
    replay.
    """

    def __init__(self, profile_hash: int, lease_ns: int, key: bytes | None = None) -> None:
        self._profile_hash = profile_hash
        self._lease_ns = lease_ns
        self._key = key
        self._sequence: int | None = None

    def datagram(self, now_ns: int, motion: Motion, time_s: float, grapple: GrappleCommand, rate: float = 1.0) -> bytes:
        """The window of ``motion`` that starts at its ``time_s``, now; ``rate`` is its seconds per real
        second.
        """
        self._sequence = now_ns // 1_000_000 if self._sequence is None else self._sequence + 1
        knots = []
        for index in range(HORIZON_KNOTS + 1):
            after_ns = index * PERIOD_NS
            position, velocity = motion.at(time_s + rate * after_ns * 1e-9)
            knots.append(Knot(after_ns, position, tuple(rate * v for v in velocity)))
        end_s = time_s + rate * HORIZON_KNOTS * PERIOD_NS * 1e-9
        setpoint = CraneSetpoint(
            self._sequence & 0xFFFF_FFFF,
            self._profile_hash,
            now_ns,
            self._lease_ns,
            grapple,
            end_s >= motion.duration_s,
            tuple(knots),
        )
        return encode(setpoint, self._key)
