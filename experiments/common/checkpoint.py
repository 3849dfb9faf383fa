"""Finished trials on disk, found again by what they depend on.

A file of JSON lines, one per trial: ``[name, outcome, origin]``.  The origin holds the run's fingerprint (sources,
weights, libraries, profiles, truth: `experiments.common.trials.checkpoint`), the digest of the job, and what the trial
cost.  A trial is used again where both are the same, whatever else the run asks for; lines of other runs stay, so that
nothing is lost by a change that is taken back.  Every line is on the disk before the next trial is waited for.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import lzma
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, NamedTuple

from experiments.common.result import ROOT, versions
from experiments.common.standing import SUFFIXES
from experiments.common.workers import TrialCost
from runtime.errors import InputRefused

SOURCES: Final = ("machine", "sim", "can_dbc", "experiments")
"""Folders of the checkout on which the outcome of every trial depends."""
ALL_SOURCES: Final = ("autonomy", "controller", "hil", "host", "recorder", "runtime", "training", "docs/examples")
"""The others on which the outcome of some trial depends."""
PARTIAL: Final = "trials.partial.jsonl.xz"
"""Beside a published file: what an interrupted run has finished."""
LIBRARIES: Final = ("numpy", "scipy", "numba", "pybullet", "openvino", "torch")
"""Libraries that compute."""


class Kept(NamedTuple):
    """A finished trial: its outcome, and its cost if it was measured."""

    outcome: Any
    cost: TrialCost | None


class Checkpoint:
    """The finished trials of one run.

    ``published``: the same lines in an xz file, used if the file at ``path`` holds no trial of this run; an interrupted
    run leaves them beside it (`PARTIAL`), so that another checkout can go on.  ``stays``: whether the file stays on the
    disk after a complete run.

    Raises:
        InputRefused: another process writes the same file, or the disk refuses it.
    """

    def __init__(self, path: Path, fingerprint: str, published: Path | None = None, stays: bool = False) -> None:
        self._path, self._fingerprint, self._published, self._stays = path, fingerprint, published, stays
        self.done: dict[str, Any] = {}
        """Outcomes of this run by the names of their jobs."""
        self._kept: dict[str, Kept] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a+b")
        except OSError as error:
            raise InputRefused(
                "experiment.trials-unwritable",
                f"trials cannot be kept in {path} ({error.strerror}): name another --out",
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise InputRefused(
                "experiment.in-use", f"another run writes {path}: wait for its end, or name another --out"
            ) from None
        self._file.seek(0)
        data = self._file.read()
        self._file.truncate(data.rfind(b"\n") + 1)  # the last run may have been cut off while it wrote
        self._take(data)
        if not self.done and published is not None:
            data = _unpacked(published) + _unpacked(published.with_name(PARTIAL))
            self._take(data)
            for name, outcome, origin in _lines(data):
                if origin.get("run") == fingerprint:
                    self._write([name, outcome, origin])

    def find(self, digest: str) -> Kept | None:
        """Find the finished trial of the job with this digest."""
        return self._kept.get(digest)

    def add(self, name: str, outcome: Any, digest: str = "", cost: TrialCost | None = None) -> None:
        """Store a finished trial; without the ``digest`` of its job it is found by its name only."""
        origin = {"run": self._fingerprint, "job": digest} | ({} if cost is None else {"cost": asdict(cost)})
        line = self._write([name, outcome, origin])
        self._remember(*json.loads(line))

    def publish(self) -> None:
        """Write the trials of this complete run to the published file, if there is one."""
        if self._published is not None:
            self._pack(self._published)
            self._published.with_name(PARTIAL).unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; it stays on disk for the next run."""
        self._file.close()

    def __enter__(self) -> Checkpoint:
        return self

    def __exit__(self, failure: type[BaseException] | None, *_: object) -> None:
        """Remove the file after a complete run unless it ``stays``; an interrupted run leaves it, also in the docs."""
        if failure is not None and self.done and self._published is not None:
            self._pack(self._published.with_name(PARTIAL))
        self.close()
        if failure is None and not self._stays:
            self._path.unlink()

    def _pack(self, path: Path) -> None:
        self._file.seek(0)
        lines = [line for line in _lines(self._file.read()) if line[2].get("run") == self._fingerprint]
        path.parent.mkdir(parents=True, exist_ok=True)
        with lzma.open(path, "wb") as file:
            file.writelines(json.dumps(line).encode() + b"\n" for line in lines)

    def _write(self, line: list[Any]) -> str:
        text = json.dumps(line)
        self._file.write(text.encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        return text

    def _take(self, data: bytes) -> None:
        for name, outcome, origin in _lines(data):
            if origin.get("run") == self._fingerprint:
                self._remember(name, outcome, origin)

    def _remember(self, name: str, outcome: Any, origin: dict[str, Any]) -> None:
        cost = TrialCost(**origin["cost"]) if "cost" in origin else None
        self.done[name] = outcome
        if origin["job"]:
            self._kept[origin["job"]] = Kept(outcome, cost)


def read_published(path: Path) -> dict[str, Any]:
    """Read the outcomes of a published file by the names of their jobs, whichever run made them.

    Raises:
        InputRefused: the file is missing or damaged.
    """
    try:
        data = lzma.decompress(path.read_bytes())
    except (OSError, lzma.LZMAError) as error:
        raise InputRefused("experiment.published-trials", f"{path} cannot be read: {error}") from None
    return {name: outcome for name, outcome, _ in _lines(data)}


def _unpacked(path: Path) -> bytes:
    """Unpack the lines of a published file; nothing where it is missing or damaged, and the trials run again."""
    try:
        return lzma.decompress(path.read_bytes())
    except (OSError, lzma.LZMAError):
        return b""


def _lines(data: bytes) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Yield name, outcome and origin of every whole line; up to the first that is not one."""
    for text in data.splitlines():
        try:
            line: Sequence[Any] | dict[str, Any] = json.loads(text)
        except ValueError:
            return
        if isinstance(line, list):  # published files of earlier releases begin with an object
            name, outcome, *origin = line
            yield name, outcome, origin[0] if origin else {}


def source_hash(*more: str) -> str:
    """Compute the hash over the content of ``SOURCES`` and of further folders or files of the checkout.

    One that does not exist counts as empty: a run after a move starts anew.
    """
    digest = hashlib.sha256()
    for folder in (*SOURCES, *more):
        for path in sorted([ROOT / folder, *(ROOT / folder).rglob("*")]):
            if path.suffix in SUFFIXES:
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def libraries() -> str:
    """List the libraries that compute, with their versions."""
    return ", ".join(f"{name} {number}" for name, number in versions(LIBRARIES).items())


def installation() -> str:
    """Describe sources and libraries of this process; the same words mean the same outcomes."""
    return f"sources {source_hash(*ALL_SOURCES)}, {libraries()}"
