"""Settled piles for training: each is brought to rest once by the plant's physics and kept on disk.

A chunk of CHUNK piles depends only on the machine and the number of the chunk, so that a split by chunk is a split by
pile.  Chunks from HELD_OUT on are never used for training; they are reserved for experiments.
"""

from __future__ import annotations

import os
import random
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from machine.loading.profile_file import load_profile
from machine.profile import Profile
from runtime.errors import InputRefused
from sim.camera.scene import Ground, LogPose
from sim.geometry import Vector
from sim.ground.terrain import Terrain
from sim.scenes.arrangements import KINDS
from sim.scenes.settled_logs import settle_logs

FORMAT_VERSION: Final = 1  # incremented when the same seed would give other piles
CHUNK: Final = 64
HELD_OUT: Final = 1_000_000
TERRAINS: Final = 12  # expensive to generate: so many are shared by all piles of a kind
MACHINES: Final = ("palms_471", "aoro_fc8")
KIND_WEIGHTS: Final = {
    "palms_471": {
        "single": 1.0,
        "separate": 2.0,
        "parallel": 1.5,
        "skewed": 1.0,
        "crossed": 2.0,
        "pile": 4.0,
        "bunk": 1.0,
    },
    "aoro_fc8": {
        "single": 1.5,
        "separate": 2.0,
        "parallel": 1.0,
        "skewed": 1.0,
        "crossed": 1.5,
        "pile": 2.0,
        "row": 2.0,
    },
}
"""How often a kind of ``sim.scenes.arrangements`` is drawn for a machine."""
MAX_LOGS: Final = {"separate": 5, "row": 10, "bunk": 12}
ROUTE_M_PER_LOG: Final = 3.2  # of a row
COLUMNS: Final = 11
MAX_DRAWS: Final = 50


@dataclass(frozen=True, slots=True)
class Pile:
    """Logs at rest in the world frame, instances 1, 2, ...

    ``kind`` as in ``sim.scenes.arrangements``; ``number`` is unique for the machine; the ground is ``terrain`` of
    ``terrain_seed`` with its datum at ``datum_m``.
    """

    machine: str
    number: int
    kind: str
    terrain: str
    terrain_seed: int
    datum_m: float
    logs: tuple[LogPose, ...]

    @property
    def middle_m(self) -> Vector:
        """Mean of the logs' middles."""
        x, y, z = np.mean([log.position_m for log in self.logs], axis=0)
        return (float(x), float(y), float(z))


@cache
def profile_of(machine: str) -> Profile:
    """Read the shipped profile of a machine, once."""
    return load_profile(machine)


@lru_cache(maxsize=2 * TERRAINS + 4)
def terrain_of(kind: str, seed: int, datum_m: float) -> Terrain:
    """Generate the ground of a pile, cached."""
    return Terrain(kind, seed, datum_m)


def ground_of(pile: Pile) -> Ground:
    """Return the ground of a pile for the renderer."""
    return Ground(*terrain_of(pile.terrain, pile.terrain_seed, pile.datum_m).grid)


def cache_folder() -> Path:
    """Return the default folder of piles: below XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "timberhand" / "piles"


def settle(machine: str, number: int) -> Pile:
    """Settle one pile by its number; a draw without room or rest is repeated.

    Raises:
        InputRefused: MAX_DRAWS draws in a row failed.
    """
    profile = profile_of(machine)
    rng = random.Random(f"pile {machine} {number}")
    mobile = profile.carrier is not None
    datum = 0.0 if mobile else profile.workspace.ground_z_m
    last: ValueError | None = None
    for _ in range(MAX_DRAWS):
        kind = rng.choices(list(KIND_WEIGHTS[machine]), list(KIND_WEIGHTS[machine].values()))[0]
        low, high = KINDS[kind]
        logs = rng.randint(max(low, 3 if kind in ("row", "bunk") else low), min(high, MAX_LOGS.get(kind, high)))
        # A fixed machine stands on a yard, a carrier on any terrain.
        ground = rng.choices(("flat", "slope", "rough"), (2.0, 1.0, 3.0) if mobile else (8.0, 1.0, 1.0))[0]
        terrain_seed = rng.randrange(TERRAINS) + (TERRAINS if number >= HELD_OUT * CHUNK else 0)
        route = ((0.0, 0.0), (6.0 + ROUTE_M_PER_LOG * logs, 0.0))
        terrain = terrain_of(ground, terrain_seed if ground == "rough" else 0, datum)
        try:
            poses = settle_logs(profile, kind, rng.getrandbits(31), logs, terrain, route)
        except ValueError as error:
            last = error
            continue
        return Pile(machine, number, kind, ground, terrain_seed if ground == "rough" else 0, datum, poses)
    raise InputRefused(
        "dataset.no-rest", f"pile {number} of {machine} did not come to rest in {MAX_DRAWS} draws; last reason: {last}"
    )


def chunk(machine: str, index: int, folder: Path | None = None, tick: Callable[[], None] = lambda: None) -> list[Pile]:
    """Return CHUNK piles, read from ``folder`` (default ``cache_folder()``) or settled and written there.

    ``tick`` is called after each pile that is settled.

    Raises:
        InputRefused: the file does not hold such piles, or a pile does not come to rest.
    """
    path = (folder or cache_folder()) / f"{machine}-{index:07d}-e{FORMAT_VERSION}.npz"
    if path.exists():
        return _read(path, machine, index)
    piles = []
    for number in range(index * CHUNK, (index + 1) * CHUNK):
        piles.append(settle(machine, number))
        tick()
    _write(path, piles)
    return piles


def piles(machine: str, first_chunk: int, chunks: int, folder: Path | None = None) -> Iterator[Pile]:
    """Yield the piles of several chunks, in order."""
    for index in range(first_chunk, first_chunk + chunks):
        yield from chunk(machine, index, folder)


def _write(path: Path, settled: list[Pile]) -> None:
    rows = [
        (*log.position_m, *log.quaternion, log.length_m, log.diameter_m, log.taper_m_m, log.sweep_m)
        for pile in settled
        for log in pile.logs
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part.npz")
    np.savez_compressed(
        part,
        logs=np.array(rows),
        counts=np.array([len(p.logs) for p in settled]),
        kinds=np.array([p.kind for p in settled]),
        terrains=np.array([p.terrain for p in settled]),
        terrain_seeds=np.array([p.terrain_seed for p in settled]),
        datum_m=np.array([p.datum_m for p in settled]),
    )
    part.replace(path)  # atomic, even if another process writes the same chunk


def _read(path: Path, machine: str, index: int) -> list[Pile]:
    try:
        with np.load(path, allow_pickle=False) as file:
            data = {name: file[name] for name in file.files}
        counts, rows = data["counts"].tolist(), data["logs"]
        if len(counts) != CHUNK or rows.shape != (sum(counts), COLUMNS) or not np.isfinite(rows).all():
            raise ValueError("wrong shape")
        out, at = [], 0
        for i, n in enumerate(counts):
            logs = tuple(
                LogPose(k + 1, tuple(r[:3]), tuple(r[3:7]), *r[7:]) for k, r in enumerate(rows[at : at + n].tolist())
            )
            at += n
            ground = (str(data["terrains"][i]), int(data["terrain_seeds"][i]), float(data["datum_m"][i]))
            out.append(Pile(machine, index * CHUNK + i, str(data["kinds"][i]), *ground, logs))
        return out
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise InputRefused(
            "dataset.bad-piles", f"{path} does not hold settled piles ({error}); delete it to have them settled again"
        ) from None
