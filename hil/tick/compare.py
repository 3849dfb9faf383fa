"""Compares the interpreter with the compiled tick on the same ticks, in one run: their bytes and their cost."""

from __future__ import annotations

import json
import lzma
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from hil.tick.worker import eviction_bytes
from host.exit_codes import CommandFailed, ExitCode
from runtime.compiled import SWITCH, find_build, source_root

SIDES: Final = {"interpreter": "0", "compiled": "1"}
Progress = Callable[[str], None]


def kept_recordings(folder: Path) -> list[Path]:
    """The recordings that the tests keep, unpacked below ``folder``: a fixed crane and a forwarder on both buses.

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
        made.append(run)
    return made


def need_build() -> str:
    """The key of the build that fits; raises CommandFailed."""
    build, reason = find_build()
    if build is None:
        raise CommandFailed(
            "tick.not-compiled", f"there is no compiled tick to compare ({reason}): timberhand compile",
            ExitCode.CONFIGURATION,
        )  # fmt: skip
    return build.key


def compare_cost(recording: Path, ticks: int, rounds: int, progress: Progress) -> dict[str, Any]:
    """Cost of each side from the quietest of ``rounds`` turns (A B A B), and the ratios of the medians.

    Other load on the computer only ever adds time, so that the smallest of several medians is nearest to the truth.
    """
    turns: dict[str, list[dict[str, Any]]] = {side: [] for side in SIDES}
    for turn in range(rounds):
        for side in SIDES:
            progress(f"{recording.parent.name}: {side}, turn {turn + 1} of {rounds}")
            turns[side].append(json.loads(_run(side, "cost", recording, ticks).splitlines()[-1]))
    sides = {
        side: {
            "tick": found[0]["tick"],
            "differing": sum(turn[caches]["differing"] for turn in found for caches in ("hot", "cold")),
            **{
                caches: {name: min(turn[caches][name] for turn in found) for name in found[0][caches] if "_us" in name}
                for caches in ("hot", "cold")
            },
        }
        for side, found in turns.items()
    }
    slow, fast = sides["interpreter"], sides["compiled"]
    return {
        "recording": recording.parent.name,
        "ticks": turns["interpreter"][0]["ticks"],
        **sides,
        "compiled_ratio_hot": round(slow["hot"]["cpu_p50_us"] / fast["hot"]["cpu_p50_us"], 2),
        "compiled_ratio_cold": round(slow["cold"]["cpu_p50_us"] / fast["cold"]["cpu_p50_us"], 2),
    }


def compare_random(recording: Path, seed: int, ticks: int, progress: Progress) -> dict[str, Any]:
    """Run the same random ticks on both sides at once; ends at the first pass whose digests differ."""
    workers = {side: _start(side, "random", recording, seed, ticks) for side in SIDES}
    agreed: dict[str, Any] = {"ticks": 0, "modes": []}
    differs_after = None
    try:
        for a, b in zip(*(_lines(worker) for worker in workers.values()), strict=False):
            if a != b:
                differs_after = agreed["ticks"]
                break
            agreed = a
            progress(f"{recording.parent.name}: {a['ticks']} of {ticks} random ticks agree")
        if differs_after is None:
            for side, worker in workers.items():
                if worker.wait() or agreed["ticks"] < ticks:
                    raise CommandFailed("tick.worker", f"the side on the {side} ended early", ExitCode.CONFIGURATION)
    finally:
        for worker in workers.values():
            worker.kill()
            worker.wait()
    return {
        "recording": recording.parent.name, "seed": seed, "ticks": agreed["ticks"], "modes": agreed["modes"],
        "differs_after": differs_after,
    }  # fmt: skip


def environment() -> dict[str, Any]:
    """What the figures depend on."""
    from importlib import metadata

    try:
        mypy = metadata.version("mypy")
    except metadata.PackageNotFoundError:
        mypy = ""
    return {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpus": os.cpu_count(), "mypy": mypy, "evicted_mb": eviction_bytes() >> 20,
    }  # fmt: skip


def _start(side: str, *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "hil.tick.worker", *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, SWITCH: SIDES[side], "OMP_NUM_THREADS": "1"},
    )


def _run(side: str, *arguments: object) -> str:
    with _start(side, *arguments) as worker:
        answer = worker.stdout.read() if worker.stdout else ""
    if worker.returncode:
        raise CommandFailed("tick.worker", f"the side on the {side} failed; see above", ExitCode.CONFIGURATION)
    return answer


def _lines(worker: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    assert worker.stdout is not None
    for line in worker.stdout:
        yield json.loads(line)
