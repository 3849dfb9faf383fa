"""Compares the interpreter with the compiled tick on the same ticks, in one run: their bytes and their cost."""

from __future__ import annotations

import json
import lzma
import math
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from hil.replay.recording import PROFILE_FILE
from hil.tick import worker
from hil.tick.release import Release
from host.exit_codes import CommandFailed, ExitCode
from runtime.compiled import SWITCH, find_build, source_root

SIDES: Final = {"interpreter": "0", "compiled": "1"}
CACHES: Final = ("hot", "cold")
MIN_RATIO: Final = 2.0
"""Cost on the interpreter over that of the compiled tick, at least."""
MIN_RELEASE_RATIO: Final = 0.9
"""Cost of the release over that of this tick, at least: it may become a tenth slower, not more."""
Progress = Callable[[str], None]


def kept_recordings(folder: Path) -> list[Path]:
    """Unpack the recordings that the tests keep below ``folder``, with the profiles of their runs: a fixed crane, and
    a forwarder on both buses.

    Raises:
        CommandFailed: this is not a checkout.
    """
    packed = sorted((source_root() / "tests" / "recordings").glob("*.mcap.xz"))
    if not packed:
        raise CommandFailed(
            "tick.no-recording",
            "an installation has no recording of its own; name one: timberhand bench tick RECORDING",
            ExitCode.CONFIGURATION,
        )
    made = []
    for path in packed:
        run = folder / path.name.removesuffix(".mcap.xz") / "run.mcap"
        run.parent.mkdir()
        run.write_bytes(lzma.decompress(path.read_bytes()))
        (run.parent / PROFILE_FILE).write_bytes(path.with_name(f"{run.parent.name}.toml").read_bytes())
        made.append(run)
    return made


def need_build() -> str:
    """Return the key of the build that fits; raises CommandFailed."""
    build, reason = find_build()
    if build is None:
        raise CommandFailed(
            "tick.not-compiled",
            f"there is no compiled tick to compare ({reason}): timberhand compile",
            ExitCode.CONFIGURATION,
        )
    return build.key


def compare_cost(
    recording: Path, ticks: int, rounds: int, progress: Progress, against: Release | None = None
) -> dict[str, Any]:
    """Measure the cost of each side over interleaved rounds (A B C A B C), and the ratios of the same rounds.

    A side's figures are those of its quietest turn, because other load only ever adds time.  A ratio is the median
    over the rounds with its interval, because the sides of one round run one after the other on the same host.
    """
    names = [*SIDES, "release"] if against else list(SIDES)
    turns: dict[str, list[dict[str, Any]]] = {side: [] for side in names}
    for turn in range(rounds):
        for side in names:
            progress(f"{recording.parent.name}: {side}, turn {turn + 1} of {rounds}")
            folder = against.folder if against and side == "release" else None
            turns[side].append(json.loads(_run(side, folder, "cost", recording, ticks).splitlines()[-1]))
    comparisons = [("compiled_ratio", "interpreter", "compiled", MIN_RATIO)]
    if against:
        comparisons.append(("release_ratio", "release", "compiled", MIN_RELEASE_RATIO))
    medians = {
        (side, caches): [float(turn[caches]["cpu_p50_us"]) for turn in figures]
        for side, figures in turns.items()
        for caches in CACHES
    }
    ratios = {
        f"{name}_{caches}": compared(medians[slow, caches], medians[fast, caches], at_least)
        for name, slow, fast, at_least in comparisons
        for caches in CACHES
    }
    return {
        "recording": recording.parent.name,
        "ticks": turns["interpreter"][0]["ticks"],
        **{side: _quietest(figures) for side, figures in turns.items()},
        **{name: figures["ratio"] for name, figures in ratios.items()},
        "ratios": ratios,
    }


def _quietest(turns: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "tick": turns[0]["tick"],
        "differing": sum(turn[caches]["differing"] for turn in turns for caches in CACHES),
        "instructions_p50": turns[0]["hot"].get("instructions_p50"),
        **{
            caches: {name: min(turn[caches][name] for turn in turns) for name in turns[0][caches] if "_us" in name}
            for caches in CACHES
        },
    }


def compare_random(recording: Path, seed: int, ticks: int, progress: Progress) -> dict[str, Any]:
    """Run the same random ticks on both sides at once; ends at the first pass whose digests differ."""
    processes = {side: _start(side, None, "random", recording, seed, ticks) for side in SIDES}
    agreed: dict[str, Any] = {"ticks": 0, "modes": []}
    differs_after = None
    try:
        for a, b in zip(*(_lines(process) for process in processes.values()), strict=False):
            if a != b:
                differs_after = agreed["ticks"]
                break
            agreed = a
            progress(f"{recording.parent.name}: {a['ticks']} of {ticks} random ticks agree")
        if differs_after is None:
            for side, process in processes.items():
                if process.wait() or agreed["ticks"] < ticks:
                    raise CommandFailed("tick.worker", f"the side on the {side} ended early", ExitCode.CONFIGURATION)
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
    return {
        "recording": recording.parent.name,
        "seed": seed,
        "ticks": agreed["ticks"],
        "modes": agreed["modes"],
        "differs_after": differs_after,
    }


def environment() -> dict[str, Any]:
    """Describe what the figures depend on."""
    from importlib import metadata

    try:
        mypy = metadata.version("mypy")
    except metadata.PackageNotFoundError:
        mypy = ""
    return {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpus": os.cpu_count(),
        "mypy": mypy,
        "evicted_mb": worker.eviction_bytes() >> 20,
    }


def _start(side: str, folder: Path | None, *arguments: object) -> subprocess.Popen[str]:
    """Start a worker of this program, which judges the packages below ``folder``, by default its own."""
    return subprocess.Popen(
        [sys.executable, "-P", worker.__file__, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env={
            **os.environ,
            SWITCH: SIDES.get(side, "1"),
            "OMP_NUM_THREADS": "1",
            "PYTHONPATH": str(folder or source_root()),
        },
    )


def _run(side: str, folder: Path | None, *arguments: object) -> str:
    with _start(side, folder, *arguments) as process:
        answer = process.stdout.read() if process.stdout else ""
    if process.returncode:
        raise CommandFailed("tick.worker", f"the side on the {side} failed; see above", ExitCode.CONFIGURATION)
    return answer


def _lines(process: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    assert process.stdout is not None
    for line in process.stdout:
        yield json.loads(line)


# -- Ratios of interleaved rounds: their median, its confidence interval, and what that says about a limit.

CONFIDENCE: Final = 0.95


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Find the interval that holds the true median with `CONFIDENCE`, between two of the sorted values (sign test).

    No assumption on the distribution, so that single disturbed rounds do not widen it; fewer than six values bound
    nothing and give an infinite interval.
    """
    ordered, n = sorted(values), len(values)
    cut, below = -1, 0.0
    while 2 * (below + math.comb(n, cut + 1) / 2**n) <= 1 - CONFIDENCE:
        cut += 1
        below += math.comb(n, cut) / 2**n
    return (ordered[cut], ordered[n - 1 - cut]) if cut >= 0 else (0.0, math.inf)


def verdict(interval: tuple[float, float], at_least: float) -> str:
    """Judge whether a ratio reaches a limit: "reached", "missed", or "inconclusive" where the interval holds it."""
    if interval[0] >= at_least:
        return "reached"
    return "missed" if interval[1] < at_least else "inconclusive"


def compared(slow: Sequence[float], fast: Sequence[float], at_least: float) -> dict[str, object]:
    """Compare two series of the same rounds: ratio's median, interval (None without an upper bound), and verdict."""
    ratios = [a / b for a, b in zip(slow, fast, strict=True)]
    low, high = median_interval(ratios)
    return {
        "ratio": round(statistics.median(ratios), 3),
        "low": round(low, 3),
        "high": round(high, 3) if math.isfinite(high) else None,
        "at_least": at_least,
        "verdict": verdict((low, high), at_least),
    }
