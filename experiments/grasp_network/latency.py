"""Latency of a picture on one thread for every inference path of the same network, and agreement of the grasps."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders
from autonomy.grasp.network import SHAPE, PixelGrasp, best_pixel, grasp_maps, normalized_relief, pixel_grasp_inference
from autonomy.grasp.virtual_scene import camera_above, operational_area, render
from autonomy.networks import Interface, OpenVinoNet, Weights, load

EAGER: Final = "PyTorch eager, original"
PATHS: Final = {
    "torch": EAGER,
    "f32": "OpenVINO f32, original",
    "heads": "OpenVINO f32, heads before the upsampling",
    "low": "OpenVINO f32, grasp only",
    "mixed": "OpenVINO mixed, grasp only",
}
MAX_DISTANCE_PX: Final = 3.0
MAX_ANGLE_DEG: Final = 3.0
SCENES: Final = 12

ORIGINAL: Final = Interface("grasp in the original order", 1, {"maps": 3})

InferencePath = Callable[[np.ndarray], PixelGrasp]


def inference_paths(weights: Weights) -> dict[str, InferencePath]:
    """Build the paths by name; each maps a picture (1, 1, 300, 300) to its grasp."""
    import torch

    from training.common.weight_file import restore, save
    from training.grasp.network_training import OriginalOrder

    torch.set_num_threads(1)
    net = OriginalOrder().eval()
    restore(net, weights.arrays())

    def eager(picture: np.ndarray) -> PixelGrasp:
        with torch.inference_mode():
            return best_pixel(grasp_maps(net(torch.from_numpy(picture))[0].numpy()))

    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder) / "original.onnx", net, ORIGINAL, {})
        original = load(Path(folder) / "original.onnx", ORIGINAL)
    return {
        "torch": eager,
        "f32": _through(OpenVinoNet(original, SHAPE)),
        "heads": _through(OpenVinoNet(weights, SHAPE, outputs=("maps",))),
        "low": pixel_grasp_inference(weights),
        "mixed": pixel_grasp_inference(weights, "mixed"),
    }


def _through(net: OpenVinoNet) -> InferencePath:
    return lambda picture: best_pixel(grasp_maps(net(picture)["maps"][0]))


def times_ms(paths: Mapping[str, InferencePath], pictures: Sequence[np.ndarray], rounds: int) -> dict[str, list[float]]:
    """Measure the CPU time of every call [ms], paths alternately, without the time spent waiting for a processor."""
    path_times_ms: dict[str, list[float]] = {name: [] for name in paths}
    for i in range(-2, rounds):
        for name, infer in paths.items():
            start_ns = time.process_time_ns()
            infer(pictures[i % len(pictures)])
            if i >= 0:
                path_times_ms[name].append((time.process_time_ns() - start_ns) / 1e6)
    return path_times_ms


def agreement(
    paths: Mapping[str, InferencePath], pictures: Sequence[np.ndarray]
) -> dict[str, list[tuple[float, float]]]:
    """Compute (distance [px], angle [deg]) of the grasp from the original PyTorch network's, by path and picture."""
    differences: dict[str, list[tuple[float, float]]] = {name: [] for name in paths}
    for picture in pictures:
        reference = paths["torch"](picture)
        for name, infer in paths.items():
            grasp = infer(picture)
            turned = abs((grasp.theta_rad - reference.theta_rad + math.pi / 2) % math.pi - math.pi / 2)
            apart = math.hypot(grasp.u_px - reference.u_px, grasp.v_px - reference.v_px)
            differences[name].append((apart, math.degrees(turned)))
    return differences


def metrics(times: Mapping[str, list[float]], apart: Mapping[str, list[tuple[float, float]]]) -> dict[str, float]:
    """Compute medians, ratios and agreement; the fastest path is the fastest of those that agree.

    Agreement is the 95th percentile over the pictures: if two places are equally good, rounding decides.
    """
    medians = {name: float(np.median(path_times_ms)) for name, path_times_ms in times.items()}
    out: dict[str, float] = {}
    worst = {name: np.percentile(pairs, 95.0, axis=0) for name, pairs in apart.items()}
    for name, median in medians.items():
        out[f"{name}_ms"] = median
        out[f"{name}_ratio"] = median / medians["torch"]
        out[f"{name}_argmax_px"], out[f"{name}_angle_deg"] = map(float, worst[name])
    agreeing = [n for n in medians if worst[n][0] <= MAX_DISTANCE_PX and worst[n][1] <= MAX_ANGLE_DEG]
    fastest = min(agreeing, key=lambda n: medians[n])
    return out | {
        "latency_ratio": out[f"{fastest}_ratio"],
        "argmax_px": out[f"{fastest}_argmax_px"],
        "angle_deg": out[f"{fastest}_angle_deg"],
    }


def log_scenes(seed: int, count: int = SCENES) -> list[tuple[np.ndarray, np.ndarray]]:
    """Make (depth [m], network input) of rendered logs on the ground, seen by paper A's virtual camera."""
    scenes = []
    for i in range(count):
        rng: Any = np.random.default_rng([seed, i])
        logs = 1 + i % 4
        turned = rng.uniform(0.0, math.pi) + rng.choice([0.0, 1.0]) * rng.uniform(0.0, 1.5, logs)
        turned = np.broadcast_to(turned, (logs,))
        radius = rng.uniform(0.06, 0.14, logs)
        height = radius + np.arange(logs) * (0.22 if i % 2 else 0.0)
        centers_m = np.stack([rng.uniform(-0.5, 0.5, logs), 4.0 + rng.uniform(-0.5, 0.5, logs), height], axis=1)
        axis = np.stack([np.cos(turned), np.sin(turned), np.zeros(logs)], axis=1)
        world = Cylinders(centers_m, axis, rng.uniform(1.2, 2.0, logs), radius)
        depth = render(world, camera_above(operational_area(world)), 0.0)
        scenes.append((depth, normalized_relief(depth)[None, None]))
    return scenes
