"""The training loop: deterministic, resumable at any step, also after Ctrl-C."""

from __future__ import annotations

import io
import os
import signal
from pathlib import Path

import pytest
import torch
from rich.console import Console
from torch import nn

from runtime.errors import InputRefused
from tests.codes import coded
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


@pytest.mark.long
def test_training_is_deterministic() -> None:
    (a, losses), (b, again) = run(None), run(None)
    assert losses == again and same(a, b)
    assert len(losses) == 40 and losses[-1] < 0.5 * losses[0]


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


@pytest.mark.long
def test_ctrl_c_finishes_the_step_and_the_same_call_resumes(tmp_path: Path) -> None:
    path = tmp_path / "kept.pt"
    whole, losses = run(None)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(path, give=stopped_at(17))
    assert signal.getsignal(signal.SIGINT) is before
    asked: list[int] = []

    def listed(i: int) -> tuple[torch.Tensor, ...]:
        asked.append(i)
        return batch(i)

    net, again = run(path, give=listed)
    assert asked == list(range(18, 40))
    assert again == losses and same(net, whole)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_checkpoint_of_another_run_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "kept.pt"
    with pytest.raises(KeyboardInterrupt):
        run(path, give=stopped_at(17))
    asked: list[int] = []

    def listed(i: int) -> tuple[torch.Tensor, ...]:
        asked.append(i)
        return batch(i)

    run(path, give=listed, run_name="other")
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
