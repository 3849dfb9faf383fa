"""Random inputs for the tick: recorded ticks with random changes, the same for the same seed.

A recording brings the controller into all its modes, random inputs alone never would.  Every pass over it has a fresh
controller and its own rate of changes, from none to one in five ticks: frames that are lost, repeated, foreign, cut or
changed (with a checksum that fits or not), datagrams that are lost, repeated, random or changed, lateness, pauses,
lost frames and bus-off.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import EXTENDED, Frame
from can_dbc.messages import datagrams
from can_dbc.messages.crane import CraneSetpoint, OperatorAction, OperatorCommand
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import TickRecord
from can_dbc.protocols.e2e import frame_crc

RATES: Final = (0.0, 0.002, 0.01, 0.05, 0.2)
"""Share of the ticks that are changed; one of them holds for a pass."""


class RandomTicks:
    """An endless supply of passes over ``recorded``."""

    def __init__(self, recorded: Sequence[TickRecord], databases: Sequence[Database], seed: int) -> None:
        self._recorded = recorded
        self._data_ids = {codec.key: codec.data_ids for database in databases for codec in database.messages.values()}
        self._keys = sorted(self._data_ids)
        self._random = random.Random(seed)

    def one_pass(self) -> Iterator[TickRecord]:
        """Yield the ticks of one pass, for a fresh controller."""
        rng = self._random
        rate, shift_ns = rng.choice(RATES), 0
        for tick in self._recorded:
            if rng.random() >= rate:
                yield replace(tick, now_ns=tick.now_ns + shift_ns)
                continue
            if rng.random() < 0.02:
                shift_ns += rng.randrange(1, 200) * 5_000_000  # the process was stopped for a while
            yield self._changed(replace(tick, now_ns=tick.now_ns + shift_ns))

    def _changed(self, tick: TickRecord) -> TickRecord:
        rng = self._random
        choice = rng.randrange(6)
        if choice < 3:
            if tick.machine_frames_in and rng.random() < 0.5:
                return replace(tick, machine_frames_in=self._changed_frames(list(tick.machine_frames_in), tick.now_ns))
            return replace(tick, frames_in=self._changed_frames(list(tick.frames_in), tick.now_ns))
        if choice == 3:
            late_ns = rng.choice((rng.randrange(5_000_000), rng.randrange(80_000_000), -rng.randrange(1000)))
            return replace(tick, late_ns=late_ns, missed_ticks=tick.missed_ticks + rng.randrange(3))
        if choice == 4:
            bus = replace(
                tick.bus,
                state=rng.randrange(5),
                dropped=tick.bus.dropped + rng.randrange(2),
                refused=tick.bus.refused + rng.randrange(2),
                errors=tick.bus.errors + rng.randrange(3),
                recoveries=tick.bus.recoveries + rng.randrange(2),
            )
            return replace(tick, bus=bus) if rng.random() < 0.5 else replace(tick, machine_bus=bus)
        if rng.random() < 0.3:
            return replace(tick, operator=self._changed_datagrams(list(tick.operator), tick.now_ns))
        return replace(tick, datagrams=self._changed_datagrams(list(tick.datagrams), tick.now_ns))

    def _changed_frames(self, frames: list[Frame], now_ns: int) -> tuple[Frame, ...]:
        rng = self._random
        for _ in range(rng.randrange(1, 4)):
            choice = rng.randrange(5)
            at = rng.randrange(len(frames)) if frames else 0
            if choice == 0 or not frames:
                key = rng.choice((rng.choice(self._keys), rng.randrange(0x800), rng.randrange(1 << 29) | EXTENDED))
                frames.insert(at, Frame(now_ns - rng.randrange(10_000_000), key, rng.randbytes(rng.randrange(9))))
            elif choice == 1:
                del frames[at]
            elif choice == 2:
                frames.append(frames[at])
            else:
                frames[at] = self._changed_frame(frames[at])
        return tuple(frames)

    def _changed_frame(self, frame: Frame) -> Frame:
        """Put random bytes into a payload, mostly under a checksum that fits."""
        rng = self._random
        data = bytearray(frame.data)
        for _ in range(rng.randrange(1, 4)):
            if data:
                data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        data_ids = self._data_ids.get(frame.key)
        if data_ids and len(data) >= 2 and rng.random() < 0.8:
            data[1] = data[1] & 0xF0 | frame.data[1] & 0x0F
            data[0] = frame_crc(bytes(data), data_ids)
        if rng.random() < 0.1:
            data = data[: rng.randrange(len(data) + 1)]
        return frame._replace(data=bytes(data))

    def _changed_datagrams(self, given: list[bytes], now_ns: int) -> tuple[bytes, ...]:
        rng = self._random
        choice = rng.randrange(5)
        if choice == 0:
            return (*given, rng.randbytes(rng.randrange(80)))
        if choice == 1 or not given:
            profile_hash = self._profile_hash()
            action = rng.choice(tuple(OperatorAction))
            return (
                *given,
                datagrams.encode(OperatorCommand(rng.randrange(1 << 32), profile_hash, now_ns, action)),
            )
        at = rng.randrange(len(given))
        if choice == 2:
            del given[at]
        elif choice == 3:
            given.append(given[at])
        else:
            given[at] = self._changed_setpoint(given[at])
        return tuple(given)

    def _changed_setpoint(self, data: bytes) -> bytes:
        """Change the knots or the lease of a crane setpoint, or one byte of any other datagram."""
        rng = self._random
        try:
            message = datagrams.decode(data)
        except DatagramRefused:
            message = None
        if not isinstance(message, CraneSetpoint):
            at = rng.randrange(len(data))
            return data[:at] + bytes((rng.randrange(256),)) + data[at + 1 :]
        size = rng.choice((1e-6, 1e-3, 0.05, 1.0))
        knots = tuple(
            knot._replace(
                position=tuple(value + rng.gauss(0.0, size) for value in knot.position),
                velocity=tuple(value + rng.gauss(0.0, size) for value in knot.velocity),
            )
            for knot in message.knots
        )
        lease_ns = rng.choice((message.lease_ns, rng.randrange(1, 600_000_000)))
        return datagrams.encode(replace(message, knots=knots, lease_ns=lease_ns))

    def _profile_hash(self) -> int:
        for tick in self._recorded:
            if tick.report:
                return datagrams.decode(tick.report).profile_hash
        return 0
