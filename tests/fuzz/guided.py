"""Fuzzes one target guided by coverage: ``python -m tests.fuzz.guided NAME [--seconds N | --runs N]``.

libFuzzer keeps an input that reaches a new branch of our modules or of the libraries that read files for them.  It
needs atheris (``pip install atheris==3.0.0``; Linux on x86-64 only, so no test depends on it) and runs one target at a
time.  A broken contract is saved as by `tests.fuzz`.  Exit codes: 0 the contract holds, 1 it is broken, 2 usage.
"""

from __future__ import annotations

import argparse
import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

INSTRUMENTED = [
    "can_dbc",
    "controller",
    "machine",
    "autonomy.missions",
    "autonomy.networks",
    "recorder",
    "mcap",
    "cantools",
]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one target; libFuzzer ends the process itself when the contract holds."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.guided", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("target")
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--runs", type=int, default=-1, help="default: no limit")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    try:
        import atheris
    except ImportError:
        parser.error("atheris is not installed; run pip install atheris==3.0.0, or use python -m tests.fuzz")
    with atheris.instrument_imports(include=INSTRUMENTED):
        from tests.fuzz.engine import Broken, judged, save, smallest
        from tests.fuzz.targets import TARGETS
    if options.target not in TARGETS:
        parser.error(f"there is no target {options.target}; choose one of {', '.join(TARGETS)}")
    target = TARGETS[options.target]
    known = Path(tempfile.mkdtemp(prefix="timberhand-fuzz-"))
    atexit.register(shutil.rmtree, known, ignore_errors=True)
    for number, data in enumerate(target.seeds()):
        (known / f"seed{number}").write_bytes(data)
    run, since = target.start(), []

    def one(data: bytes) -> None:
        nonlocal run
        if len(since) >= min(target.runs_per_state, 5000):
            run = target.start()
            since.clear()
        if target.mend is not None and data[-1:] > b"\x40":  # most inputs get past the checksums
            data = target.mend(data)
        since.append(data)
        try:
            judged(run, data)
        except Broken as broken:
            sys.stderr.write(f"{target.name}: {broken}\nsaved: {save(target, smallest(target, since))}\n")
            os._exit(1)

    limits = [f"-runs={options.runs}", f"-max_total_time={options.seconds}", f"-seed={options.seed}"]
    atheris.Setup([sys.argv[0], *limits, f"-max_len={target.max_bytes}", "-rss_limit_mb=4096", str(known)], one)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
