"""What a tick does while nobody looks at the console's pages and while ten of them are open, in turn, in one run.

Controller, guard, emulated machine and console are processes on the wire (`experiments.timing.testbed`).  The system
calls of a tick and the frames that it sends are counts: no other load of the computer changes them.  Instructions are
counted where the host lets us.  Processor time is a time, so it is a ratio to the windows without pages, with its
interval: other load and shared caches change it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from threading import Thread
from typing import Any, Final

from websockets.sync.client import ClientConnection, connect

from experiments.timing.measurement import system_calls
from experiments.timing.testbed import HOST, WAIT_S, TestbedConfig, TimingTestbed
from hil.harness.processes import free_udp_ports
from hil.tick.compare import compared

PROFILE: Final = "palms_471"
RATE_HZ: Final = 200
MIN_RATIO: Final = 0.9
"""Processor time of a tick without pages over that with pages, at least: they share the caches of a small computer."""
SAME: Final = 0.02
"""Counts of a tick that differ by less are the same: a window begins and ends within some tick, and the setpoint source
sends by its own clock."""
SETTLE_S: Final = 1.0
PANELS: Final = ("can", "ticks", "error", "timeline")
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Window:
    """Some seconds of the controller, its system calls, instructions and sent frames per tick (None: not counted here);
    ``states`` went to the pages meanwhile."""

    ticks: int
    missed: int
    cpu_us: float
    frames: float
    instructions: float | None
    calls: float | None
    states: int = 0


def measure(rounds: int, seconds: float, pages: int, directory: Path, progress: Progress) -> dict[str, list[Window]]:
    """Measure windows without pages and with ``pages``, in turn; ``directory`` keeps what processes write to stderr.

    Raises:
        CommandFailed: a process does not start or ends.
    """
    reports, port = free_udp_ports(2)
    windows: dict[str, list[Window]] = {"none": [], "open": []}
    with TimingTestbed(TestbedConfig(PROFILE, RATE_HZ, report_ports=(reports,)), directory) as testbed:
        testbed.helpers.environment = testbed.family.environment  # the console listens on the same wire
        options = {"profile": PROFILE, "port": port, "report_port": reports, "timing": testbed.page}
        testbed.helpers.start("console", "console", **options, bus="crane0=wire:crane0", key_file=testbed.key_file)
        testbed.helpers.await_message("console", "url", WAIT_S)
        for number in range(rounds):
            for side in ("none", "open") if number % 2 == 0 else ("open", "none"):
                progress(f"round {number + 1} of {rounds}: {pages if side == 'open' else 'no'} pages")
                with _opened(testbed, port, pages if side == "open" else 0) as states:
                    window = _window(testbed, seconds, directory)
                windows[side].append(replace(window, states=sum(states)))
    return windows


@contextmanager
def _opened(testbed: TimingTestbed, port: int, pages: int) -> Iterator[list[int]]:
    """Open so many pages without drawing: each reads every state and shows a panel.  Yield the states of each so far.

    One of the panels is the CAN table, for which the console listens on the bus.
    """
    states = [0] * pages

    def read(number: int, page: ClientConnection) -> None:
        for _ in page:
            states[number] += 1

    with ExitStack() as stack:
        for number in range(pages):
            page = stack.enter_context(connect(f"ws://{HOST}:{port}/ws", max_size=None))
            page.send(f"panel {PANELS[number % len(PANELS)]}")
            Thread(target=read, args=(number, page), daemon=True).start()
        testbed.wait(SETTLE_S)
        yield states


def _window(testbed: TimingTestbed, seconds: float, directory: Path) -> Window:
    mark = testbed.mark()
    testbed.wait(seconds)
    span = testbed.since(mark)
    traced = system_calls(testbed, seconds, directory)
    sent = [sum(bus.sent for bus in facts.buses) for facts in (span.begin, span.end)]
    return Window(
        span.ticks,
        span.missed,
        cpu_us=span.cpu_ns / span.ticks / 1e3,
        frames=(sent[1] - sent[0]) / span.ticks,
        instructions=None if span.instructions is None else span.instructions / span.ticks,
        calls=None if traced is None else sum(traced[0].values()) / traced[1],
    )


def judge(found: dict[str, list[Window]]) -> dict[str, Any]:
    """Compute the figures: medians of each side, whether its counts are the same, and the ratio of the processor times.

    ``same`` of a count is None where it was not counted.  ``reached`` is false when a count differs or the ratio is
    certainly missed; a ratio whose interval holds the limit is inconclusive, and no failure.
    """
    counts = {name: _compared(found, name) for name in ("calls", "frames", "instructions")}
    ratio = compared([w.cpu_us for w in found["none"]], [w.cpu_us for w in found["open"]], MIN_RATIO)
    return {
        "counts": counts,
        "cpu": {side: round(median(w.cpu_us for w in found[side]), 1) for side in found} | ratio,
        "missed": {side: sum(w.missed for w in found[side]) for side in found},
        "ticks": {side: sum(w.ticks for w in found[side]) for side in found},
        "states": sum(w.states for w in found["open"]),
        "reached": ratio["verdict"] != "missed" and all(c["same"] is not False for c in counts.values()),
    }


def _compared(found: dict[str, list[Window]], name: str) -> dict[str, Any]:
    counted = {side: [v for w in windows if (v := getattr(w, name)) is not None] for side, windows in found.items()}
    if not all(counted.values()):
        return {"none": None, "open": None, "same": None}
    sides = {side: median(values) for side, values in counted.items()}
    same = abs(sides["open"] - sides["none"]) <= SAME * sides["none"]
    return {side: round(value, 2) for side, value in sides.items()} | {"same": same}
