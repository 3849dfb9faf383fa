"""The training run of the mask network: any device, by steps or by minutes, with an average of the weights."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch.nn import functional as F

from autonomy.perception.segmentation.mask_network import FEATURES, KERNEL_STRIDE, PLACE_PX
from autonomy.perception.segmentation.network import MAPS, STRIDE
from training.common.loop import channels_last, deferred_interrupt
from training.detection.masks.bank import Bank, windows
from training.detection.masks.disturbances import Chance, inputs
from training.detection.masks.goals import Goals, goals
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
    """Make the network, its trunk from pretrained arrays."""
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
    """Train and return the averaged arrays.

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
    step, elapsed_before_s = _continued(checkpoint, identity, net, optimiser, mean, generator)
    began, last_report_s, last_save_s = time.monotonic() - elapsed_before_s, elapsed_before_s, elapsed_before_s

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
            for name, loss_part in {"loss": value.detach(), **parts}.items():
                sums[name] = sums.get(name, 0.0) + loss_part
            sums["n"] = sums.get("n", 0) + 1
            now = time.monotonic() - began
            if now - last_report_s > 5.0 or step == run.steps:
                tell(
                    {"step": step, "s": round(now, 1), "rate": rate, "pictures": len(bank)}
                    | {k: round(float(v) / sums["n"], 4) for k, v in sums.items() if k != "n"}
                )
                sums, last_report_s = {}, now
            if now - last_save_s > 60.0:
                keep(_arrays(mean), step)
                note()
                last_save_s = now
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
    """Restore the state of an interrupted run and return its step and seconds; 0 without one."""
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


# -- The loss of the mask network: of its maps, of where kernels are, and of the masks that kernels make.

PEAK_WEIGHT: Final = 20.0
EDGE_WEIGHT, BETWEEN_WEIGHT = 3.0, 8.0
OFFSET_SHARE, ANGLE_SHARE, PEAK_SHARE, EDGE_SHARE = 0.1, 1.0, 0.4, 1.0
MAPS_SHARE, HEAT_SHARE, KERNEL_SHARE = 0.5, 1.0, 3.0
KERNELS_OF_A_LOG: Final = 2
KERNELS_OF_A_PICTURE: Final = 20


def loss(
    out: tuple[torch.Tensor, torch.Tensor], g: Goals, generator: torch.Generator
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Compute the loss of a batch, and its parts for the record; ``out`` are maps and kernels."""
    maps, kernels = (values.float() for values in out)
    parts = {
        "maps": maps_loss(maps, g),
        "heat": heat_loss(kernels[:, 0], g),
        "kernel": kernel_loss(maps[:, len(MAPS) :], kernels[:, 1:], g, generator),
    }
    total = MAPS_SHARE * parts["maps"] + HEAT_SHARE * parts["heat"] + KERNEL_SHARE * parts["kernel"]
    return total, {name: part.detach() for name, part in parts.items()}


def maps_loss(found: torch.Tensor, g: Goals) -> torch.Tensor:
    """Compute cross entropy of mask, peaks and edges, distances of offsets and angles."""
    weight, angle_weight, meeting = g.weights.unbind(1)
    own = weight * g.valid

    def entropy(i: int, factor: torch.Tensor) -> torch.Tensor:
        error = F.binary_cross_entropy_with_logits(found[:, i], g.maps[:, i], reduction="none")
        return (error * factor).sum() / (factor.detach() > 0).sum().clamp(min=1)

    probability, truth = torch.sigmoid(found[:, 0]) * g.wood, g.maps[:, 0] * g.wood
    shared, sizes = (probability * truth).sum((1, 2)), (probability + truth).sum((1, 2))
    value = 4.0 * entropy(0, weight * g.wood) / 2.0 + (1.0 - 2.0 * (shared + 1.0) / (sizes + 2.0)).mean()
    for i in (1, 6):
        value = value + PEAK_SHARE * entropy(i, own * (1.0 + PEAK_WEIGHT * g.maps[:, i]))
    value = value + EDGE_SHARE * entropy(7, own * (1.0 + EDGE_WEIGHT * g.maps[:, 7] + BETWEEN_WEIGHT * meeting))
    inside = (g.maps[:, 4:6].abs().sum(1) > 0) * g.valid
    miss = torch.log1p((found[:, 2:4] - g.maps[:, 2:4]).abs().sum(1))
    value = value + OFFSET_SHARE * (miss * inside).sum() / (inside.sum() + 1.0)
    angle = (found[:, 4:6] - g.maps[:, 4:6]).abs().sum(1) * angle_weight * g.valid
    return value + ANGLE_SHARE * angle.sum() / ((angle_weight * g.valid).sum() + 1e-3)


def heat_loss(heat: torch.Tensor, g: Goals) -> torch.Tensor:
    """Compute the focal loss of a ridge, as for centres of objects."""
    cell = KERNEL_STRIDE // STRIDE
    open_ = (F.avg_pool2d(g.valid[:, None], cell)[:, 0] > 0.6).float()
    p = torch.sigmoid(heat).clamp(1e-5, 1 - 1e-5)
    sure = (g.heat > 0.75).float()
    hit = -((1 - p) ** 2) * torch.log(p) * sure
    miss = -((1 - g.heat) ** 4) * p**2 * torch.log(1 - p) * (1 - sure)
    return ((hit + miss) * open_).sum() / sure.sum().clamp(min=1.0)


def kernel_loss(features: torch.Tensor, kernels: torch.Tensor, g: Goals, generator: torch.Generator) -> torch.Tensor:
    """Compute Dice and cross entropy of the masks of a few kernels of every log."""
    b, n = g.masks.shape[:2]
    columns = kernels.shape[3]
    # For every log, cells near its middle, at random.
    numbers = torch.arange(n, device=features.device)[None, :, None, None]
    own = (g.owner[:, None] == numbers) * g.heat[:, None]
    noise = torch.rand(own.shape, generator=generator, device=own.device)
    value, cell = (own * (0.6 + 0.8 * noise)).flatten(2).topk(KERNELS_OF_A_LOG, dim=2)
    least = torch.tensor([0.05] + [0.35] * (KERNELS_OF_A_LOG - 1), device=value.device)
    value = torch.where((value > least) & (g.counts > 0)[..., None], value, torch.zeros_like(value))
    value, candidate_index = value.flatten(1).topk(KERNELS_OF_A_PICTURE, dim=1)
    use, log, at = (value > 0).float(), candidate_index // KERNELS_OF_A_LOG, cell.flatten(1).gather(1, candidate_index)
    k = kernels.flatten(2).gather(2, at[:, None].expand(-1, kernels.shape[1], -1)).transpose(1, 2)
    logits = mask_logits(features, k, at // columns, at % columns)
    rows = torch.arange(b, device=log.device)[:, None]
    truth, valid = g.masks[rows, log], g.valid[:, None]
    p = torch.sigmoid(logits) * valid
    shared, sizes = (p * truth).sum((2, 3)), (p.square() + truth).sum((2, 3))
    dice = 1.0 - (2.0 * shared + 2.0) / (sizes + 2.0)
    weight = (g.valid * (0.08 + g.maps[:, 0] + 2.0 * g.weights[:, 2]))[:, None]
    entropy = (F.binary_cross_entropy_with_logits(logits, truth, reduction="none") * weight).sum((2, 3))
    each = dice + 0.5 * entropy / (truth.sum((2, 3)) + 60.0)
    return (each * use).sum() / use.sum().clamp(min=1.0)


def mask_logits(features: torch.Tensor, kernels: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Compute logits (B, K, h, w) of the masks of kernels (B, K, KERNEL) at cells (B, K)."""
    h, w = features.shape[2:]
    middle, half = KERNEL_STRIDE / 2.0 - 0.5, 0.5 * (STRIDE - 1)
    x = torch.arange(w, device=features.device) * STRIDE + half - (column[..., None] * KERNEL_STRIDE + middle)
    y = torch.arange(h, device=features.device) * STRIDE + half - (row[..., None] * KERNEL_STRIDE + middle)
    x, y = (x / PLACE_PX)[:, :, None, :], (y / PLACE_PX)[:, :, :, None]
    a, b, c, d, e, constant = kernels[..., FEATURES:, None, None].unbind(2)
    flat = torch.einsum("bkc,bchw->bkhw", kernels[..., :FEATURES], features)
    return flat + (a * x + c * x * x) + (b * y + e * y * y + constant) + (d * y) * x
