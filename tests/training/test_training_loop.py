"""What all trainings share: the loop, deterministic and resumable at any step, and average precision."""

from __future__ import annotations

import io
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from torch import nn

from runtime.errors import InputRefused
from tests.codes import coded
from training.common.average_precision import (
    Matches,
    average_precision,
    box_overlaps,
    curve,
    mask_overlaps,
)
from training.common.loop import Schedule, seeded, train


def small() -> nn.Module:
    return nn.Sequential(nn.Conv2d(1, 4, 3, padding=1), nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 1, 1))


def batch(step: int) -> tuple[torch.Tensor, ...]:
    x = torch.randn(2, 1, 8, 8, generator=torch.Generator().manual_seed(step))
    return x, 0.5 * x


def loss(net: nn.Module, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return (net(x) - y).square().mean()


def run(path: Path | None, steps: int = 40, give=batch, every_s: float = 1e9, run_name: str = "r"):
    net = seeded(small, 1)
    schedule = Schedule(steps, 1e-2, checkpoint_every_s=every_s)
    return net, train(net, give, loss, schedule, path, run_name, "small", Console(file=io.StringIO()))


def same(a: nn.Module, b: nn.Module) -> bool:
    return all(torch.equal(x, b.state_dict()[k]) for k, x in a.state_dict().items())


def test_a_seed_gives_the_same_net_and_leaves_the_global_generator_alone() -> None:
    before = torch.random.get_rng_state()
    first, second, other = (seeded(small, seed) for seed in (1, 1, 2))
    assert same(first, second) and not same(first, other)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_the_rate_rises_then_falls() -> None:
    schedule = Schedule(100, 1.0)
    rates = [schedule.rate(i) for i in range(100)]
    assert rates[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert rates[5:] == sorted(rates[5:], reverse=True) and 0.0 < rates[-1] < 0.01


def stopped_at(step: int):
    def give(i: int) -> tuple[torch.Tensor, ...]:
        if i == step:
            os.kill(os.getpid(), signal.SIGINT)
        return batch(i)

    return give


def noting(asked: list[int]):
    def give(i: int) -> tuple[torch.Tensor, ...]:
        asked.append(i)
        return batch(i)

    return give


@pytest.mark.long
def test_ctrl_c_finishes_the_step_and_the_same_call_resumes(tmp_path: Path) -> None:
    path = tmp_path / "kept.pt"
    whole, losses = run(None)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(path, give=stopped_at(17))
    assert signal.getsignal(signal.SIGINT) is before
    asked: list[int] = []
    net, again = run(path, give=noting(asked))
    assert asked == list(range(18, 40))
    assert again == losses and same(net, whole), "deterministic, whether stopped or not"
    assert len(losses) == 40 and losses[-1] < 0.5 * losses[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_checkpoint_of_another_run_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "kept.pt"
    with pytest.raises(KeyboardInterrupt):
        run(path, give=stopped_at(17))
    asked: list[int] = []
    run(path, give=noting(asked), run_name="other")
    assert asked == list(range(40))
    with pytest.raises(KeyboardInterrupt):
        run(path, give=stopped_at(5))
    path.write_bytes(path.read_bytes()[:100])
    assert run(path)[1] == run(None)[1]


def test_a_checkpoint_is_written_at_intervals(tmp_path: Path) -> None:
    path = tmp_path / "kept.pt"

    def fails(i: int) -> tuple[torch.Tensor, ...]:
        if i == 3:
            raise OSError("no data")
        return batch(i)

    with pytest.raises(OSError, match="no data"):
        run(path, give=fails, every_s=0.0)
    assert len(torch.load(path, weights_only=True)["losses"]) == 3


def test_a_loss_that_is_not_finite_stops_the_run() -> None:
    with pytest.raises(InputRefused, check=coded("training.diverged")):
        run(None, give=lambda i: (batch(i)[0] * (float("nan") if i == 2 else 1.0), batch(i)[1]))


# -- average precision on cases worked out by hand
def matches(scores, overlaps, ignored=None):
    overlaps = np.array(overlaps, float).reshape(len(scores), -1)
    return Matches(np.array(scores, float), overlaps, np.array(ignored or [False] * overlaps.shape[1], bool))


def test_overlaps_of_boxes():
    found = [(0, 0, 10, 10), (5, 0, 15, 10), (20, 20, 20, 30)]
    assert box_overlaps(found, [(0, 0, 10, 10)])[:, 0] == pytest.approx([1.0, 1 / 3, 0.0])
    assert box_overlaps([], [(0, 0, 1, 1)]).shape == (0, 1)
    assert box_overlaps([(0, 0, 1, 1)], []).shape == (1, 0)


def test_overlaps_of_masks():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    a[:2], b[1:3] = True, True
    assert mask_overlaps([a, b], [b])[:, 0] == pytest.approx([1 / 3, 1.0])
    assert mask_overlaps([], [a]).shape == (0, 1)


@pytest.mark.parametrize(
    ("scores", "overlaps", "average"),
    [
        ([0.9, 0.8], [[0.9, 0.0], [0.0, 0.6]], 1.0),
        ([0.9, 0.8], [[0.0], [0.7]], 0.5),
        ([0.8, 0.9], [[0.0], [0.7]], 1.0),
        ([0.9], [[0.9, 0.0]], 51 / 101),
    ],
    ids=["perfect", "the surest is wrong", "a less sure one is wrong", "half of the truths at 51 of 101 recalls"],
)
def test_the_average_of_a_curve(scores, overlaps, average):
    assert curve([matches(scores, overlaps)], 0.5).average == pytest.approx(average)


def test_a_ground_truth_is_matched_once():
    double = curve([matches([0.9, 0.8], [[0.9], [0.9]])], 0.5)
    assert double.precision.tolist() == [1.0, 0.5]
    assert double.average == pytest.approx(1.0)


def test_a_worked_example_of_two_pictures():
    # By score: right (a), wrong (b), right (b); three truths.  Precision 1, 1/2, 2/3 at recall 1/3, 1/3, 2/3.
    a = matches([0.9], [[0.8, 0.1]])
    b = matches([0.8, 0.7], [[0.2], [0.6]])
    whole = curve([a, b], 0.5)
    assert whole.precision == pytest.approx([1.0, 0.5, 2 / 3])
    assert whole.recall == pytest.approx([1 / 3, 1 / 3, 2 / 3])
    # Recalls 0..0.33 (34 of them) read 1, 0.34..0.66 (33) read 2/3, the rest 0.
    assert whole.average == pytest.approx((34 + 33 * 2 / 3) / 101)


def test_ignored_truths_have_no_effect():
    one = matches([0.9, 0.8], [[0.8, 0.0], [0.0, 0.9]], [True, False])
    assert curve([one], 0.5).average == pytest.approx(1.0)
    assert curve([one], 0.5).scores.tolist() == [0.8]
    # A truth that counts is preferred, even when an ignored one is overlapped more.
    two = matches([0.9], [[0.8, 0.6]], [True, False])
    assert curve([two], 0.5).average == pytest.approx(1.0)


def test_the_mean_over_thresholds_rewards_tight_detections():
    assert average_precision([matches([0.9], [[0.74]])]) == pytest.approx(0.5)  # 0.50, 0.55, 0.60, 0.65, 0.70
    assert average_precision([matches([0.9], [[1.0]])]) == pytest.approx(1.0)


def test_without_truths_the_average_is_nan():
    assert np.isnan(curve([matches([0.5], [[]])], 0.5).average)
    assert curve([Matches(np.zeros(0), np.zeros((0, 1)), np.array([False]))], 0.5).average == 0.0
