"""The training run of the mask network: any device, by steps or by minutes, with an average of the weights."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from training.common.loop import channels_last, deferred_interrupt
from training.detection.masks.bank import Bank, windows
from training.detection.masks.disturbances import Chance, inputs
from training.detection.masks.goals import goals
from training.detection.masks.losses import loss
from training.detection.networks import MaskNetwork


@dataclass(frozen=True, slots=True)
class Run:
    """How to train: windows of a batch and their side [px], learning rate, seconds (the schedule ends with them), at
    most ``steps``, seed."""

    batch: int = 64
    side_px: int = 320
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    seconds: float = 480.0
    steps: int = 1_000_000
    seed: int = 1
    average: float = 0.998
    large_every: int = 4
    """Every so manieth batch has fewer windows of half again the side."""


def start_net(trunk: Mapping[str, np.ndarray] | None, seed: int) -> MaskNetwork:
    """The network, its trunk from ``pretrained`` arrays."""
    torch.manual_seed(seed)
    net = MaskNetwork()
    with torch.no_grad():
        for module in net.modules():
            if isinstance(module, torch.nn.Conv2d):
                torch.nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
                if module.bias is not None:
                    torch.nn.init.zeros_(module.bias)
        for last in (net.maps, net.kernels):
            torch.nn.init.normal_(last.weight, std=0.01)
            if last.bias is not None:
                last.bias[0] = -3.0
        if trunk is not None:
            state = net.state_dict()
            for name, array in trunk.items():
                state[name].copy_(torch.from_numpy(array))
    return net


def train(
    bank: Bank,
    run: Run,
    trunk: Mapping[str, np.ndarray] | None,
    tell: Callable[[dict[str, Any]], None],
    keep: Callable[[dict[str, np.ndarray], int], None],
    more: Callable[[int], Bank | None] = lambda _: None,
    checkpoint: Path | None = None,
) -> dict[str, np.ndarray]:
    """Train; returns the averaged arrays.

    ``tell`` gets a record now and then, ``keep`` the averaged arrays; ``more`` may replace the pictures.
    With ``checkpoint`` the same call continues where it was interrupted; Ctrl-C finishes the step first.
    """
    device = bank.ids.device
    fast = device.type == "cuda"
    if fast:
        torch.backends.cudnn.benchmark = True
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    generator = torch.Generator(device).manual_seed(run.seed)
    chance = Chance(generator)
    net = channels_last(start_net(trunk, run.seed).to(device)).train()
    old: list[torch.nn.Parameter] = []
    new: list[torch.nn.Parameter] = []
    for name, p in net.named_parameters():
        (old if trunk is not None and name in trunk else new).append(p)
    groups = [{"params": old, "share": 0.5}, {"params": new, "share": 1.0}]
    optimiser = torch.optim.AdamW(groups, run.learning_rate, weight_decay=run.weight_decay, fused=fast)
    mean = {k: v.detach().float().clone() for k, v in net.state_dict().items()}
    sums: dict[str, Any] = {}
    identity = f"{run} {len(bank)} {trunk is not None}"
    step, before = _continued(checkpoint, identity, net, optimiser, mean, generator)
    began, told, kept = time.monotonic() - before, before, before

    def note() -> None:
        if checkpoint is not None:
            state = {
                "run": identity,
                "step": step,
                "s": time.monotonic() - began,
                "net": net.state_dict(),
                "optimiser": optimiser.state_dict(),
                "mean": mean,
                "chance": generator.get_state(),
            }
            draft = checkpoint.with_name(checkpoint.name + ".part")
            torch.save(state, draft)
            draft.replace(checkpoint)

    with deferred_interrupt() as interrupts:
        while True:
            if interrupts:
                note()
                raise KeyboardInterrupt
            spent = time.monotonic() - began
            part = max(spent / run.seconds, step / run.steps)
            if part >= 1.0:
                break
            bank = more(step) or bank
            rate = (
                run.learning_rate
                * min(1.0, (step + 1) / 200.0)
                * (0.02 + 0.98 * 0.5 * (1.0 + math.cos(math.pi * part)))
            )
            for group in optimiser.param_groups:
                group["lr"] = rate * group["share"]
            large = step % run.large_every == run.large_every - 1
            count, side = (
                (max(2, run.batch // 3), run.side_px * 3 // 2 // 64 * 64) if large else (run.batch, run.side_px)
            )
            with torch.no_grad():
                w = windows(bank, count, side, generator)
                images, aim = inputs(w, chance).contiguous(memory_format=torch.channels_last), goals(w)
            with torch.autocast(device.type, torch.bfloat16, enabled=fast):
                out = net(images)
            value, parts = loss(out, aim, generator)
            optimiser.zero_grad(set_to_none=True)
            value.backward()  # type: ignore[no-untyped-call]  # torch has no annotation for it
            torch.nn.utils.clip_grad_norm_(net.parameters(), 10.0)
            optimiser.step()
            step += 1
            with torch.no_grad():
                decay = min(run.average, (step + 1) / (step + 10))
                floats = [(mean[k], v.float()) for k, v in net.state_dict().items() if v.is_floating_point()]
                torch._foreach_lerp_([a for a, _ in floats], [v for _, v in floats], 1.0 - decay)
            for name, one in {"loss": value.detach(), **parts}.items():
                sums[name] = sums.get(name, 0.0) + one
            sums["n"] = sums.get("n", 0) + 1
            now = time.monotonic() - began
            if now - told > 5.0 or step == run.steps:
                tell(
                    {"step": step, "s": round(now, 1), "rate": rate, "pictures": len(bank)}
                    | {k: round(float(v) / sums["n"], 4) for k, v in sums.items() if k != "n"}
                )
                sums, told = {}, now
            if now - kept > 60.0:
                keep(_arrays(mean), step)
                note()
                kept = now
    done = _arrays(mean)
    keep(done, step)
    note()
    return done


def _continued(
    checkpoint: Path | None,
    name: str,
    net: MaskNetwork,
    optimiser: torch.optim.Optimizer,
    mean: dict[str, torch.Tensor],
    generator: torch.Generator,
) -> tuple[int, float]:
    """Step and seconds of an interrupted run, whose state is restored; 0 without one."""
    if checkpoint is None or not checkpoint.is_file():
        return 0, 0.0
    try:
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True, map_location=generator.device)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError):
        return 0, 0.0
    if state.get("run") != name:
        return 0, 0.0
    net.load_state_dict(state["net"])
    optimiser.load_state_dict(state["optimiser"])
    mean.update(state["mean"])
    generator.set_state(state["chance"].cpu())
    return int(state["step"]), float(state["s"])


def _arrays(mean: Mapping[str, torch.Tensor]) -> dict[str, np.ndarray]:
    return {name: values.cpu().numpy().copy() for name, values in mean.items() if not name.endswith("batches_tracked")}
