"""One fold of a cross-validation on Cornell data: trains on the rest, tests on every picture of the fold.

``grouped``: runs of neighbouring numbers, tested on their original crops.  ``paper``: augmented views split at
random, tested on views, as paper A describes.
"""

from __future__ import annotations

import hashlib
import io
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common.pool import Job
from training.grasp.cornell import Sample, grouped_folds, load, paper_folds
from training.grasp.network_training import (
    BATCH,
    LEARNING_RATE,
    VIEWS_PER_SAMPLE,
    Example,
    GraspNetwork,
    augmented_examples,
    evaluate,
    median_size_px,
    plain_examples,
    predict,
    train_network,
)

FOLDS: Final = 10
KINDS: Final = ("grouped", "paper")


def perform(job: Job) -> list[dict[str, Any]]:
    """Compute the results for every test picture of fold ``options["fold"]``."""
    import torch

    torch.set_num_threads(1)
    samples, crops, views = _examples(job.options["data"], job.seed)
    quiet = Console(file=io.StringIO())
    epochs = job.options["epochs"]
    if job.kind == "grouped":
        training_part, test_part = grouped_folds([s.number for s in samples], FOLDS)[job.options["fold"]]
        many = VIEWS_PER_SAMPLE
        training_examples = [views[many * i + k] for i in training_part for k in range(many)]
        numbers = {samples[i].number for i in test_part}
        test_examples = [e for e in crops if e.number in numbers]
        size = median_size_px([e for e in crops if e.number in {samples[i].number for i in training_part}])
    else:
        training_part, test_part = paper_folds(len(views), FOLDS, job.seed)[job.options["fold"]]
        training_examples, test_examples = [views[i] for i in training_part], [views[i] for i in test_part]
        size = median_size_px(training_examples)
    net, _ = train_network(training_examples, job.seed, job.name, quiet, epochs=epochs)
    predictions = predict(net, test_examples)
    return [
        {"number": e.number, **evaluate(maps, e.grasps, size)}
        for e, maps in zip(test_examples, predictions, strict=True)
    ]


@lru_cache(maxsize=1)
def _examples(folder: str, seed: int) -> tuple[tuple[Sample, ...], list[Example], list[Example]]:
    samples = load(Path(folder))
    return samples, plain_examples(samples), augmented_examples(samples, seed)


def identity(samples: tuple[Sample, ...], seed: int, epochs: int) -> str:
    """Compute the hash of everything that decides a fold's outcome: network, schedule and preprocessed pictures."""
    digest = hashlib.sha256(
        f"{GraspNetwork()} {seed} {epochs} {VIEWS_PER_SAMPLE} {BATCH} {LEARNING_RATE} {len(samples)}".encode()
    )
    for example in (*plain_examples(samples[:2]), *augmented_examples(samples[:1], seed, 2)):
        digest.update(example.low.tobytes() + example.projected.tobytes())
    return digest.hexdigest()[:16]
