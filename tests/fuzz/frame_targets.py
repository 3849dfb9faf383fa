"""CAN frames: random traffic among the regular one, into the whole controller and into the guard.

An input is a script of `RECORD`s.  A frame has a key that the receiver knows, or any key, and a checksum and counter
that fit, or not; an action lets time pass, presses a button, or sends a setpoint.  So the controller is met in all its
modes.  After every tick what went out is judged: neutral where the mode demands it, the arm key only while armed,
every frame within the layout that the database gives it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import EXTENDED, Frame
from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.e2e import Sender
from machine.status.modes import Mode
from tests.controller.bench import AORO, DATABASE, GNSS, MACHINE, SETTINGS, Bench
from tests.controller.guard_traffic import MOVING, Traffic
from tests.fuzz.engine import Run, Target

RECORD: Final = struct.Struct("<BBI8s")
"""What to do, flags, key, payload."""
MAX_RECORDS: Final = 24
_FRAME, _MACHINE_FRAME, _TICKS, _OPERATOR, _PLANNER, _DATAGRAM, _BUS = range(7)
_KNOWN, _GOOD_CRC = 0x80, 0x40
_LENGTHS: Final = 9

Step = tuple[int, int, int, bytes]


def records(data: bytes) -> list[Step]:
    """What to do, flags, key and payload, one after the other."""
    return list(RECORD.iter_unpack(data[: min(len(data) // RECORD.size, MAX_RECORDS) * RECORD.size]))


class Protector:
    """Frames with a checksum and a counter that fit, per message."""

    def __init__(self, *databases: Database) -> None:
        self.codecs = [codec for database in databases for codec in database.messages.values()]
        self._senders = {codec.key: Sender(codec.data_ids) for codec in self.codecs if codec.data_ids}

    def frame(self, flags: int, number: int, payload: bytes, now_ns: int) -> Frame:
        """The frame of a record; its stamp lies up to 8 ms before ``now_ns``, or far away."""
        key = number & ~0x2000_0000 & 0xFFFF_FFFF
        if flags & _KNOWN:
            codec = self.codecs[number % len(self.codecs)]
            key = codec.key
            if codec.by_pgn and number >> 16 & 1:
                key = key & ~0xFF | number >> 8 & 0xFF  # another source address
        elif not key & EXTENDED:
            key &= 0x7FF
        data = payload[: (flags & 0x0F) % _LENGTHS]
        sender = self._senders.get(key)
        if sender is not None and flags & _GOOD_CRC and len(data) >= 2:
            data = sender.protect(data)
        age_ns = (payload[7] & 7) * 1_000_000 if flags & 0x30 else (payload[7] - 128) * 1_000_000_000
        return Frame(max(0, now_ns - age_ns), key, data)


def script(*steps: Step) -> bytes:
    """The bytes of a script."""
    return b"".join(RECORD.pack(what, flags, key, payload.ljust(8, b"\0")) for what, flags, key, payload in steps)


def scripts() -> list[bytes]:
    """Every message with a good and with a wrong checksum, and some of the operator's and the planner's day."""
    day = [(_OPERATOR, a, 0, b"") for a in (4, 1, 3, 2)]
    made = [
        script(*day[:2], (_PLANNER, 0, 0, b""), (_TICKS, 10, 0, b""), (_PLANNER, 1, 0, b""), (_TICKS, 20, 0, b"")),
        script((_OPERATOR, 3, 0, b""), (_TICKS, 60, 0, b""), (_OPERATOR, 4, 0, b""), (_TICKS, 9, 0, b""), *day[:2]),
        script((_DATAGRAM, 0, 0, b"12345678"), (_BUS, 3, 0, b""), (_TICKS, 3, 0, b""), *day[:2]),
        script(*((_FRAME, 8, 0x580 + node, bytes((0x43, 0x18, 0x10, 1, 7, 0, 0, 0))) for node in range(2, 20))),
        script(*((_FRAME, 1, 0x700 + node, bytes((state,))) for node in (1, 2, 3, 16, 32) for state in (0, 4, 5, 127))),
        script(*((_FRAME, 8, 0x80 + node, bytes((0, code, 1))) for node in (2, 3, 4, 16) for code in (0x81, 0x50, 0))),
        script(*((_MACHINE_FRAME, 8, EXTENDED | 0x18EEFF27, bytes((k,) * 8)) for k in range(12)), (_TICKS, 3, 0, b"")),
    ]
    for kind, flags in ((_FRAME, _GOOD_CRC), (_MACHINE_FRAME, _GOOD_CRC), (_FRAME, 0), (_MACHINE_FRAME, 0)):
        for first in range(0, 48, 16):
            steps = [(kind, _KNOWN | flags | 0x18, number, bytes((number * 37 & 0xFF,) * 8)) for number in range(16)]
            made.append(script(*((k, f, first + n, p) for k, f, n, p in steps), (_TICKS, 1, 0, b"")))
    return made


def _judge(bench: Bench) -> None:
    mode = bench.mode
    commands = bench.commands_b
    if commands and mode not in (Mode.ACTIVE, Mode.STOP):
        assert bench.neutral, f"{mode.name}: {bench.commands_a} {commands}"
    if commands and mode not in (Mode.ARMED, Mode.ACTIVE) and not bench.controller.supervisor.ramping:
        assert commands["ArmKey"] == 0, mode
    if commands:
        assert commands["Aux"] == 0.0 and bench.commands_a["Mode"] in (0, 2)
    for frames in (bench.controller.outputs.frames, bench.controller.outputs.machine_frames):
        for _, data in frames:
            assert 0 < len(data) <= 8


def controller(settings: object) -> Run:
    """The whole controller of one machine on its bench."""
    bench = Bench(settings).active(ticks=10)
    crane = Protector(DATABASE)
    machine = Protector(MACHINE, GNSS)

    def tick(datagrams: Sequence[bytes] = (), **measured: int) -> None:
        bench.tick(datagrams, **measured)
        _judge(bench)

    def perform(what: int, flags: int, key: int, payload: bytes) -> None:
        match what % 7:
            case 0:
                frame = crane.frame(flags, key, payload, bench.now_ns)
                bench.extra.append((frame.key, frame.data))
            case 1:
                frame = machine.frame(flags, key, payload, bench.now_ns)
                bench.machine_extra.append((frame.key, frame.data))
            case 2:
                for _ in range(flags % 32 + 1 if flags & 0x80 else flags % 4 + 1):
                    tick()
            case 3:
                tick([bench.operator(OperatorAction(flags % 4 + 1))])
            case 4:
                tick([bench.moving(key % 5, 0.05) if flags & 1 else bench.hold()])
            case 5:
                tick([payload])
            case _:
                tick(bus_state=flags % 5, late_ns=(payload[0] - 64) * 1_000_000)

    def run(data: bytes) -> Hashable:
        if bench.mode is not Mode.ACTIVE:  # an operator tries to start again
            for action in (OperatorAction.RESET, OperatorAction.ARM):
                bench.run(3)
                tick([bench.operator(action)])
            tick([bench.hold()])
        for step in records(data):
            perform(*step)
        tick()
        return bench.mode, bench.reason

    return run


def guard() -> Run:
    """The guard among its usual traffic."""
    traffic = Traffic().good()
    protector = Protector(DATABASE)

    def run(data: bytes) -> Hashable:
        for what, flags, key, payload in records(data):
            match what % 4:
                case 0 | 1:
                    traffic.extra.append(protector.frame(flags, key, payload, traffic.now_ns))
                case 2:
                    traffic.a.update(MOVING if flags & 1 else {"Mode": 0, "Slew": 0.0})
                    traffic.estop["ResetReq"] = flags >> 1 & 1
                    traffic.tick(flags % 4 + 1)
                case _:
                    traffic.tick()
        traffic.tick()
        for _, sent in traffic.sent:
            assert 0 < len(sent) <= 8
        return traffic.guard.verdict, traffic.guard.enabled

    return run


def _target(name: str, start: Callable[[], Run], runs_per_state: int, kinds: int) -> Target:
    def frames(data: bytes) -> int:
        return sum(what % kinds < 2 for what, *_ in records(data))

    size = MAX_RECORDS * RECORD.size
    return Target(name, "frames", start, scripts, runs_per_state=runs_per_state, max_bytes=size, count=frames)


FRAMES = (
    _target("controller-loader", partial(controller, SETTINGS), 400, 7),
    _target("controller-forwarder", partial(controller, AORO), 400, 7),
    _target("guard", guard, 1000, 4),
)
