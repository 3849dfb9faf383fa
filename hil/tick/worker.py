"""One side of a comparison: ``python -m hil.tick.worker``, on the compiled tick unless ``TIMBERHAND_COMPILED=0``.

``cost RECORDING TICKS`` replays a recording twice, hot and cold, and prints one JSON object.
``counted RECORDING TICKS`` replays it once with evicted caches, for valgrind (`hil.tick.counted`).  ``replay
RECORDING`` prints the digest of all outputs and how many ticks differ from it.  ``random RECORDING SEED TICKS`` runs
random ticks and prints a digest of all outputs after every pass.  ``pipe PROFILE`` reads tick records, each behind its
length (u32), and answers each with the digest of its outputs.
"""

from __future__ import annotations

import contextlib
import gc
import hashlib
import json
import platform
import random
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import EXTENDED, Frame
from can_dbc.messages import datagrams
from can_dbc.messages.crane import CraneSetpoint, OperatorAction, OperatorCommand
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import TickRecord
from can_dbc.protocols.e2e import frame_crc
from runtime.compiled import activate, running

if TYPE_CHECKING:
    from can_dbc.messages.tick_record import TickRecord
    from controller.config import Settings


# -- Random inputs for the tick: recorded ticks with random changes, the same for the same seed.
#
# A recording brings the controller into all its modes, random inputs alone never would.  Every pass over it has a
# fresh controller and its own rate of changes, from none to one in five ticks: frames that are lost, repeated,
# foreign, cut or changed (with a checksum that fits or not), datagrams that are lost, repeated, random or changed,
# lateness, pauses, lost frames and bus-off.

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
        """The ticks of one pass, for a fresh controller."""
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
        """A payload with random bytes, mostly under a checksum that fits."""
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
        """A crane setpoint with other knots or another lease; any other datagram with one other byte."""
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


WARM_TICKS: Final = 200
CACHE_LINE_BYTES: Final = 64
MIN_EVICTION_BYTES: Final = 24 << 20
COUNTED_CACHE_BYTES: Final = 2 << 20
"""Last level of the processor that valgrind simulates."""


def eviction_bytes() -> int:
    """A size that does not fit beside the tick in the last-level cache: three quarters more, within reason."""
    sizes = [MIN_EVICTION_BYTES * 4 // 7]
    for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        text = path.read_text().strip()
        sizes.append(int(text[:-1]) << {"K": 10, "M": 20}.get(text[-1], 0) if text[-1].isalpha() else int(text))
    return min(max(sizes) * 7 // 4, 128 << 20)


def digest_of(outputs: tuple[Any, ...]) -> bytes:
    """A digest of the frames and reports of one tick."""
    frames, machine_frames, report, vehicle_report = outputs
    made = hashlib.sha256()
    for part in (frames, machine_frames):
        made.update(struct.pack("<I", len(part)))
        for key, data in part:
            made.update(struct.pack("<IB", key, len(data)) + data)
    made.update(struct.pack("<I", len(report)) + report + vehicle_report)
    return made.digest()


def recorded(place: Path, limit: int) -> tuple[Settings, list[TickRecord]]:
    """Settings and the first ticks of a recording."""
    from hil.replay import replay
    from hil.replay.recording import files_of, manifest_of

    files = files_of(place)
    ticks = list(islice(replay.recorded_ticks(files), limit or None))
    # This worker runs with the packages of older releases too; before profiles lay beside recordings they had no such.
    beside = getattr(replay, "profile_beside", None)
    return replay.settings_for(manifest_of(files), ticks[:64], beside and beside(files)), ticks


def cost(place: Path, limit: int) -> dict[str, Any]:
    """Replay with warm and with evicted caches: quantiles of time and of processor time [us], and differing ticks.

    The cost of the stopwatch itself is subtracted.
    """
    settings, ticks = recorded(place, limit)
    evicted = bytearray(eviction_bytes())
    lines = bytes(len(evicted) // CACHE_LINE_BYTES)

    def evict() -> None:
        evicted[::CACHE_LINE_BYTES] = lines

    _use_huge_pages()
    gc.collect()
    gc.freeze()
    gc.disable()
    return {
        "tick": str(running()),
        "ticks": len(ticks),
        "hot": _timed(settings, ticks, lambda: None),
        "cold": _timed(settings, ticks, evict),
    }


def counted(place: Path, limit: int) -> dict[str, Any]:
    """Replay with evicted caches of a simulated processor; the number of ticks."""
    from controller.process.tick_recording import restore_inputs
    from controller.step import Controller, step
    from controller.tick import Inputs

    settings, ticks = recorded(place, limit)
    evicted = bytearray(3 * COUNTED_CACHE_BYTES)
    lines = bytes(len(evicted) // CACHE_LINE_BYTES)
    gc.collect()
    gc.freeze()
    gc.disable()
    controller, inputs = Controller(settings), Inputs()
    for tick in ticks:
        restore_inputs(inputs, tick)
        evicted[::CACHE_LINE_BYTES] = lines
        step(controller, inputs, tick.now_ns)
    return {"tick": str(running()), "counted": len(ticks)}


def replayed(place: Path) -> dict[str, Any]:
    """What runs the tick here, how many ticks give other bytes than the recording, and the digest of all bytes."""
    from controller.process.tick_recording import restore_inputs, transmitted
    from controller.step import Controller, step
    from controller.tick import Inputs

    settings, ticks = recorded(place, 0)
    controller, inputs, differing, digest = Controller(settings), Inputs(), 0, hashlib.sha256()
    for tick in ticks:
        restore_inputs(inputs, tick)
        made = transmitted(step(controller, inputs, tick.now_ns))
        differing += made != (tick.frames_out, tick.machine_frames_out, tick.report, tick.vehicle_report)
        digest.update(digest_of(made))
    return {
        "tick": str(running()),
        "machine": platform.machine(),
        "ticks": len(ticks),
        "differing": differing,
        "digest": digest.hexdigest(),
    }


def _timed(settings: Settings, ticks: list[TickRecord], between: Callable[[], None]) -> dict[str, Any]:
    from controller.process.tick_recording import restore_inputs, transmitted
    from controller.step import Controller, step
    from controller.tick import Inputs

    controller, inputs = Controller(settings), Inputs()
    wall, cpu, counts = [], [], []
    differing = 0
    timer_wall, timer_cpu = _timer_cost(between)
    counter = _counter()
    for tick in ticks:
        restore_inputs(inputs, tick)
        between()
        counted = counter() if counter else 0
        cpu_begin, begin = time.thread_time_ns(), time.perf_counter_ns()
        outputs = step(controller, inputs, tick.now_ns)
        end, cpu_end = time.perf_counter_ns(), time.thread_time_ns()
        if counter:
            counts.append(counter() - counted)
        wall.append(end - begin - timer_wall)
        cpu.append(cpu_end - cpu_begin - timer_cpu)
        differing += transmitted(outputs) != (
            tick.frames_out,
            tick.machine_frames_out,
            tick.report,
            tick.vehicle_report,
        )
    return {
        "differing": differing,
        "instructions_p50": sorted(counts)[len(counts) // 2] if counts else None,
        **_quantiles("", wall),
        **_quantiles("cpu_", cpu),
    }


def _use_huge_pages() -> None:
    """As the controller does before its first tick; the release that is judged may be older."""
    with contextlib.suppress(ImportError):
        from runtime.memory import collapse_heap

        collapse_heap()


def _counter() -> Callable[[], int] | None:
    """Reads the instructions of this thread; None where the host, or the release that is judged, counts none."""
    try:
        from hil.tick.instructions import INSTRUCTIONS, count, open_counter
    except ImportError:
        return None
    descriptor = open_counter(0, INSTRUCTIONS)
    return None if descriptor is None else partial(count, descriptor)


def _timer_cost(between: Callable[[], None]) -> tuple[int, int]:
    """Median of what the stopwatch itself takes with these caches, time and processor time [ns]."""
    wall, cpu = [], []
    for _ in range(101):
        between()
        cpu_begin, begin = time.thread_time_ns(), time.perf_counter_ns()
        end, cpu_end = time.perf_counter_ns(), time.thread_time_ns()
        wall.append(end - begin)
        cpu.append(cpu_end - cpu_begin)
    return sorted(wall)[50], sorted(cpu)[50]


def _quantiles(prefix: str, durations_ns: list[int]) -> dict[str, float]:
    ordered = sorted(durations_ns[WARM_TICKS:] or durations_ns)
    return {
        f"{prefix}p50_us": ordered[len(ordered) // 2] / 1000,
        f"{prefix}p99_us": ordered[len(ordered) * 99 // 100] / 1000,
    }


def random_ticks(place: Path, seed: int, wanted: int) -> None:
    """Run random ticks; after each pass print ticks so far, modes seen, and the digest of everything."""
    from can_dbc.dbc.codec import load
    from controller.process.tick_recording import restore_inputs, transmitted
    from controller.step import Controller, step
    from controller.tick import Inputs

    settings, ticks = recorded(place, 0)
    crane, machine, gnss = load("crane"), load("machine"), load("gnss")
    supply = RandomTicks(ticks, (crane, machine, gnss), seed)
    done, modes, digest = 0, set(), hashlib.sha256()
    while done < wanted:
        controller, inputs = Controller(settings, crane, (machine, gnss)), Inputs()
        for tick in supply.one_pass():
            restore_inputs(inputs, tick)
            outputs = step(controller, inputs, tick.now_ns)
            digest.update(digest_of(transmitted(outputs)))
            modes.add(outputs.mode.name)
            done += 1
        print(json.dumps({"ticks": done, "digest": digest.hexdigest(), "modes": sorted(modes)}), flush=True)


def pipe(profile: str) -> None:
    """Answer every tick record on stdin with the digest of its outputs on stdout."""
    from can_dbc.messages import tick_record
    from controller.config import load as load_settings
    from controller.process.tick_recording import restore_inputs, transmitted
    from controller.step import Controller, step
    from controller.tick import Inputs

    controller, inputs = Controller(load_settings(profile)), Inputs()
    sys.stdout.buffer.write(str(running()).encode() + b"\n")
    sys.stdout.buffer.flush()
    while size := sys.stdin.buffer.read(4):
        (length,) = struct.unpack("<I", size)
        if length == 0:
            controller, inputs = Controller(load_settings(profile)), Inputs()
            continue
        tick = tick_record.decode(sys.stdin.buffer.read(length))
        restore_inputs(inputs, tick)
        sys.stdout.buffer.write(digest_of(transmitted(step(controller, inputs, tick.now_ns))))
        sys.stdout.buffer.flush()


def main(arguments: list[str]) -> int:
    """Run one command."""
    activate()
    command, *rest = arguments
    if command == "cost":
        print(json.dumps(cost(Path(rest[0]), int(rest[1]))))
    elif command == "counted":
        print(json.dumps(counted(Path(rest[0]), int(rest[1]))))
    elif command == "replay":
        print(json.dumps(replayed(Path(rest[0]))))
    elif command == "random":
        random_ticks(Path(rest[0]), int(rest[1]), int(rest[2]))
    else:
        pipe(rest[0])
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
