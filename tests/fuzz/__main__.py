"""Fuzzes every surface that reads bytes from outside: ``python -m tests.fuzz``, or ``make fuzz ARGS="..."``.

Without options each target runs for `DEFAULT_S`; ``--units N`` runs each until it has judged N of its units, and at
most ``--seconds``.  A target that breaks its contract stops, its inputs are made smaller and saved in
``tests/fuzz/regressions``, where the tests replay them.  Exit codes: 0 every contract holds, 1 one is broken, 2 usage.
"""

from __future__ import annotations

import argparse
import os
import pickle
import sys
from collections.abc import Sequence
from typing import Any

from tests.fuzz.engine import Result, Target, fuzz, save, smallest
from tests.fuzz.file_targets import FILES
from tests.fuzz.frame_targets import FRAMES
from tests.fuzz.message_targets import MESSAGES
from tests.fuzz.plc_targets import PLC

TARGETS = {target.name: target for target in (*FRAMES, *MESSAGES, *PLC, *FILES)}
DEFAULT_S = 20.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the targets; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="default: all of them")
    parser.add_argument("--seconds", type=float, help=f"time for each target; default {DEFAULT_S:g} s")
    parser.add_argument("--runs", type=int, help="inputs for each target")
    parser.add_argument("--units", type=int, help="frames, datagrams, answers ... for each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="targets side by side")
    options = parser.parse_args(arguments)
    limits = {name: getattr(options, name) for name in ("seed", "runs", "units", "seconds")}
    if options.runs is options.units is options.seconds is None:
        limits["seconds"] = DEFAULT_S
    results = _side_by_side([TARGETS[n] for n in options.target or TARGETS], options.jobs, limits)
    broken = [r for r in results if r.failure]
    print(f"\n{len(results)} targets, {sum(r.runs for r in results)} inputs, {len(broken)} broken")
    for result in broken:
        print(f"  {result.name}: {result.failure}\n    saved: {result.saved}")
    return 1 if broken else 0


def _line(result: Result) -> str:
    verdict = f"BROKEN: {result.failure}" if result.failure else "holds"
    units = f"{result.units} {result.unit}"
    return (
        f"{result.name:24} {result.runs:>9} inputs {units:>22} {result.outcomes:>5} outcomes {result.seconds:7.1f} s "
        f"{result.grown_bytes >> 10:>6} KiB  {verdict}"
    )


def _side_by_side(targets: Sequence[Target], jobs: int, limits: dict[str, Any]) -> list[Result]:
    """One process per target, because memory is judged and a hang must not end the others."""
    waiting, running, results = list(targets), {}, []
    while waiting or running:
        while waiting and len(running) < jobs:
            target = waiting.pop(0)
            read, write = os.pipe()
            child = os.fork()
            if child == 0:
                os.close(read)
                _in_child(target, limits, write)
            os.close(write)
            running[child] = (target, read)
        child, status = os.wait()
        target, read = running.pop(child)
        with os.fdopen(read, "rb") as pipe:
            data = pipe.read()
        result = pickle.loads(data) if data else Result(target.name, target.unit, failure=f"ended with {status}")
        results.append(result)
        print(_line(result), flush=True)
    return results


def _in_child(target: Target, limits: dict[str, Any], write: int) -> None:
    code = 1
    try:
        result = fuzz(target, **limits)
        if result.failure:
            result.saved = save(target, smallest(target, result.inputs))
        result.inputs = []
        with os.fdopen(write, "wb") as pipe:
            pipe.write(pickle.dumps(result))
        code = 0
    finally:
        os._exit(code)


if __name__ == "__main__":
    sys.exit(main())
