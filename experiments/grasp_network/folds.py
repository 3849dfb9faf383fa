"""One fold of a cross-validation on Cornell data: train on the rest, judge every picture of the fold.

``grouped``: runs of neighbouring numbers, tested on their plain crops.  ``paper``: augmented copies dealt at random,
tested on copies, as paper A describes it.
"""

from __future__ import annotations

import hashlib
import io
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from autonomy.networks.graph import fingerprint
from experiments.common.pool import Job
from training.grasp import train
from training.grasp.cornell import Sample, grouped_folds, load, paper_folds

FOLDS: Final = 10
KINDS: Final = ("grouped", "paper")


def perform(job: Job) -> list[dict[str, Any]]:
    """Every judged picture of fold ``options["fold"]``."""
    import torch

    torch.set_num_threads(1)
    samples, plain, copies = _examples(job.options["data"], job.seed)
    quiet = Console(file=io.StringIO())
    epochs = job.options["epochs"]
    if job.kind == "grouped":
        train, test = grouped_folds([s.number for s in samples], FOLDS)[job.options["fold"]]
        many = train.COPIES
        learned = [copies[many * i + k] for i in train for k in range(many)]
        numbers = {samples[i].number for i in test}
        asked = [e for e in plain if e.number in numbers]
        size = train.usual_size([e for e in plain if e.number in {samples[i].number for i in train}])
    else:
        train, test = paper_folds(len(copies), FOLDS, job.seed)[job.options["fold"]]
        learned, asked = [copies[i] for i in train], [copies[i] for i in test]
        size = train.usual_size(learned)
    net, _ = train.fit(learned, job.seed, job.name, quiet, epochs=epochs)
    found = train.predict(net, asked)
    return [{"number": e.number, **train.judge(maps, e.grasps, size)} for e, maps in zip(asked, found, strict=True)]


@lru_cache(maxsize=1)
def _examples(folder: str, seed: int) -> tuple[tuple[Sample, ...], list[train.Example], list[train.Example]]:
    samples = load(Path(folder))
    return samples, train.plain(samples), train.copies(samples, seed)


def identity(samples: tuple[Sample, ...], seed: int, epochs: int) -> str:
    """Of all that decides a fold's outcome: the network, the schedule, and the pictures as it sees them."""
    digest = hashlib.sha256(f"{fingerprint(train.BODY)} {seed} {epochs} {train.COPIES} {train.BATCH} "
                            f"{train.LEARNING_RATE} {len(samples)}".encode())  # fmt: skip
    for example in (*train.plain(samples[:2]), *train.copies(samples[:1], seed, 2)):
        digest.update(example.low.tobytes() + example.pulled.tobytes())
    return digest.hexdigest()[:16]
