"""One training loop for every network: AdamW with warm-up and cosine schedule, deterministic, resumable at any step.

The batch of a step is a function of its number, so that a resumed run equals an uninterrupted one.  Progress is shown
on stderr.  Ctrl-C finishes the step, writes a checkpoint and raises KeyboardInterrupt.
"""

from __future__ import annotations

import math
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from runtime.errors import InputRefused
from training.common.weight_file import restore

Batch = tuple[torch.Tensor, ...]
Net = TypeVar("Net", bound=torch.nn.Module)
WARM_UP_SHARE: Final = 0.05
"""Share of the steps in which the learning rate rises."""
LOSS_SMOOTHING: Final = 0.98


@dataclass(frozen=True, slots=True)
class Schedule:
    """Steps, peak learning rate, weight decay, whether products are computed in bf16, checkpoint interval."""

    steps: int
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    bf16: bool = False
    checkpoint_every_s: float = 120.0

    def rate(self, step: int) -> float:
        """Compute the learning rate of a step (0-based)."""
        warm = max(1, round(WARM_UP_SHARE * self.steps))
        if step < warm:
            return self.learning_rate * (step + 1) / warm
        return self.learning_rate * 0.5 * (1.0 + math.cos(math.pi * (step - warm) / max(1, self.steps - warm)))


def train(
    net: torch.nn.Module,
    batch: Callable[[int], Batch],
    loss: Callable[..., torch.Tensor],
    schedule: Schedule,
    checkpoint: Path | None,
    run: str,
    title: str,
    console: Console,
) -> list[float]:
    """Train in place and return the loss of every step.

    Args:
        net: the module to train.
        batch: returns the tensors of a step; depends on the number of the step only.
        loss: returns the scalar loss of the net and these tensors.
        schedule: as above.
        checkpoint: file that is written at intervals and removed at the end; None disables checkpoints.
        run: identifies network and data; a checkpoint of another run is ignored.
        title: of the progress bar.
        console: of the progress bar.

    Raises:
        InputRefused: the loss is not finite.
        KeyboardInterrupt: after Ctrl-C.
    """
    optimiser = torch.optim.AdamW(net.parameters(), schedule.learning_rate, weight_decay=schedule.weight_decay)
    name = f"{run} {asdict(schedule) | {'checkpoint_every_s': 0}}"
    losses = _read_checkpoint(checkpoint, name, net, optimiser)
    net.train()
    written_s = time.monotonic()
    with progress_bar(console, TextColumn("{task.fields[loss]}")) as progress:
        task = progress.add_task(title, total=schedule.steps, completed=len(losses), loss="")
        smooth = losses[-1] if losses else None
        with deferred_interrupt() as interrupted:
            for step in range(len(losses), schedule.steps):
                value = _step(net, optimiser, batch(step), loss, schedule, step)
                if not math.isfinite(value):
                    raise InputRefused(
                        "training.diverged", f"{title}: the loss of step {step} is {value}; lower the learning rate"
                    )
                losses.append(value)
                smooth = value if smooth is None else LOSS_SMOOTHING * smooth + (1.0 - LOSS_SMOOTHING) * value
                progress.update(task, advance=1, loss=f"loss {smooth:.4f}")
                due = time.monotonic() - written_s > schedule.checkpoint_every_s
                if checkpoint and (due or interrupted):
                    _write_checkpoint(checkpoint, name, net, optimiser, losses)
                    written_s = time.monotonic()
                if interrupted:
                    raise KeyboardInterrupt
    if checkpoint:
        checkpoint.unlink(missing_ok=True)
    return losses


def seeded(make: Callable[[], Net], seed: int) -> Net:
    """Make a network with random parameters from a seed; torch's global generator is not affected."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def initialised(make: Callable[[], Net], seed: int, start: Mapping[str, np.ndarray] | None) -> Net:
    """Make a network of pictures with the arrays ``start``, or with random parameters from ``seed``."""
    net = seeded(make, seed)
    if start is not None:
        restore(net, start)
    return channels_last(net)


def channels_last(net: Net) -> Net:
    """Return the net with its parameters in channels-last layout, which convolutions on a CPU prefer."""
    moved: Net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # absent from the stubs
    return moved


def stacked(rows: Sequence[tuple[np.ndarray, ...]]) -> tuple[torch.Tensor, ...]:
    """Stack a batch from samples, whose first array is the picture."""
    images, *rest = (torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))
    return (images.contiguous(memory_format=torch.channels_last), *rest)


@contextmanager
def deferred_interrupt() -> Iterator[list[int]]:
    """Collect Ctrl-C instead of raising it in the middle of a step, where the weights are half updated."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted  # only the main thread receives signals
        return
    before = signal.signal(signal.SIGINT, lambda number, _: noted.append(number))
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


def _step(
    net: torch.nn.Module,
    optimiser: torch.optim.Optimizer,
    tensors: Batch,
    loss: Callable[..., torch.Tensor],
    schedule: Schedule,
    step: int,
) -> float:
    for group in optimiser.param_groups:
        group["lr"] = schedule.rate(step)
    optimiser.zero_grad(set_to_none=True)
    with torch.autocast("cpu", torch.bfloat16, enabled=schedule.bf16):
        value = loss(net, *tensors)
    value.backward()  # type: ignore[no-untyped-call]  # torch has no annotation for it
    optimiser.step()
    return value.item()


def _write_checkpoint(
    path: Path, name: str, net: torch.nn.Module, optimiser: torch.optim.Optimizer, losses: list[float]
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    torch.save({"run": name, "net": net.state_dict(), "optimiser": optimiser.state_dict(), "losses": losses}, draft)
    os.replace(draft, path)


def _read_checkpoint(
    path: Path | None, name: str, net: torch.nn.Module, optimiser: torch.optim.Optimizer
) -> list[float]:
    if path is None or not path.is_file():
        return []
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError):
        return []
    if state.get("run") != name:
        return []
    net.load_state_dict(state["net"])
    optimiser.load_state_dict(state["optimiser"])
    return list(state["losses"])


# -- Progress bars of trainings, on stderr.


def progress_bar(console: Console, *extra: ProgressColumn) -> Progress:
    """Make a bar with description, count and remaining time that vanishes at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), *extra)
    return Progress(*columns, console=console, transient=True)
