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
import struct
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runtime.compiled import activate, running

if TYPE_CHECKING:
    from can_dbc.messages.tick_record import TickRecord
    from controller.config import Settings

WARM_TICKS: Final = 200
CACHE_LINE_BYTES: Final = 64
MIN_EVICTION_BYTES: Final = 24 << 20
COUNTED_CACHE_BYTES: Final = 2 << 20
"""Last level of the processor that valgrind simulates."""


def eviction_bytes() -> int:
    """Find a size that does not fit beside the tick in the last-level cache: three quarters more, within reason."""
    sizes = [MIN_EVICTION_BYTES * 4 // 7]
    for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size"):
        text = path.read_text().strip()
        sizes.append(int(text[:-1]) << {"K": 10, "M": 20}.get(text[-1], 0) if text[-1].isalpha() else int(text))
    return min(max(sizes) * 7 // 4, 128 << 20)


def digest_of(outputs: tuple[Any, ...]) -> bytes:
    """Compute a digest of the frames and reports of one tick."""
    frames, machine_frames, report, vehicle_report = outputs
    made = hashlib.sha256()
    for part in (frames, machine_frames):
        made.update(struct.pack("<I", len(part)))
        for key, data in part:
            made.update(struct.pack("<IB", key, len(data)) + data)
    made.update(struct.pack("<I", len(report)) + report + vehicle_report)
    return made.digest()


def recorded(place: Path, limit: int) -> tuple[Settings, list[TickRecord]]:
    """Read settings and the first ticks of a recording."""
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
    """Tell what runs the tick here, how many ticks give other bytes than the recording, and the digest of all bytes."""
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
    """Collapse the heap as the controller does before its first tick; the release that is judged may be older."""
    with contextlib.suppress(ImportError):
        from runtime.memory import collapse_heap

        collapse_heap()


def _counter() -> Callable[[], int] | None:
    """Return a reader of this thread's instructions; None where the host, or the release that is judged, has none."""
    try:
        from hil.tick.instructions import INSTRUCTIONS, count, open_counter
    except ImportError:
        return None
    descriptor = open_counter(0, INSTRUCTIONS)
    return None if descriptor is None else partial(count, descriptor)


def _timer_cost(between: Callable[[], None]) -> tuple[int, int]:
    """Measure the median of what the stopwatch itself takes with these caches, time and processor time [ns]."""
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
    from hil.tick.random_ticks import RandomTicks

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
