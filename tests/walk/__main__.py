"""``python -m tests.walk tick [--files]``: how many files of the project a reader enters who follows one tick.

A tick of `controller.step.step`, interpreted, on the bench of the controller's tests, of a crane that moves by fresh
setpoints: palms_471 on its fixed base, and aoro_fc8 with its carrier.  Shown are the usual tick of a second (the median
by files and jumps) and the fullest, which accepts a setpoint or reports the state.  A jump is a call from one file into
another.  The codecs, which are compiled from the databases at start-up, count as one file.  No clock and no randomness:
the same sources give the same numbers.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from types import FrameType
from typing import Any, NamedTuple

from controller.config import Settings
from runtime.compiled import stay_interpreted
from tests.controller.bench import AORO, SETTINGS, Bench
from tests.docs.pages import ROOT

CODECS = "codecs compiled at start-up"
RENEWED_TICKS = 10
"""Ticks between two setpoints of the planner."""


class Walk(NamedTuple):
    """One tick: calls by file, and jumps by the two files."""

    calls: Counter[str]
    jumps: Counter[tuple[str, str]]


def file_of(name: str) -> str | None:
    """The file of the project that holds this code; None for what is not the project's."""
    if name.startswith("<"):
        return CODECS if "codec" in name or "dbc" in name else None
    path = name.removeprefix(f"{ROOT}/")
    return None if path == name or path.startswith((".venv", "tests")) else path


def walked(bench: Bench, setpoint: list[bytes]) -> Walk:
    """One tick of the bench as a walk; only what `step` calls counts."""
    walk = Walk(Counter(), Counter())
    stack: list[str | None] = []

    def on_event(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            if not stack and frame.f_code.co_name != "step":
                return
            here = file_of(frame.f_code.co_filename)
            caller = next((name for name in reversed(stack) if name), None)
            if here is not None and (stack or here == "controller/step.py"):
                walk.calls[here] += 1
                walk.jumps[caller or "", here] += caller not in (None, here)
            if stack or here == "controller/step.py":
                stack.append(here)
        elif event == "return" and stack:
            stack.pop()

    sys.setprofile(on_event)
    try:
        bench.tick(setpoint)
    finally:
        sys.setprofile(None)
    return walk


def second(settings: Settings) -> list[Walk]:
    """Every tick of a second of motion, the shortest walk first."""
    bench = Bench(settings).active()
    walks = [walked(bench, [] if k % RENEWED_TICKS else [bench.moving(0, 0.08)]) for k in range(settings.rate_hz)]
    return sorted(walks, key=lambda walk: (len(walk.calls), walk.jumps.total()))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.walk", description="What a reader of the code enters.")
    parser.add_argument("walk", choices=("tick",))
    parser.add_argument("--files", action="store_true", help="list the files of the usual tick, and who jumps there")
    options = parser.parse_args()
    stay_interpreted()
    for settings in (SETTINGS, AORO):
        walks = second(settings)
        usual, full = walks[len(walks) // 2], walks[-1]
        for name, walk in (("usual", usual), ("fullest", full)):
            print(f"{settings.profile.name}, {name} tick: {len(walk.calls)} files, {walk.jumps.total()} jumps")
        for file, calls in usual.calls.most_common() if options.files else ():
            into = Counter({a: n for (a, b), n in usual.jumps.items() if b == file and n})
            print(f"  {calls:4} calls  {file}  from {', '.join(f'{a} {n}' for a, n in into.most_common(4)) or '-'}")


if __name__ == "__main__":
    main()
