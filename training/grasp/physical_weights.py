"""Paper A's network trained on physical labels of settled piles instead of Cornell rectangles.

Network, loss and schedule are the same, and ``autonomy.grasp.cnn_planner`` uses the weights like the paper's.  The
piles come from ``training.pictures.piles``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console
from rich.progress import Progress

from autonomy.grasp.cylinders import Cylinders, default_covariance, sample_cylinders
from autonomy.grasp.network import MAX_RELIEF, PAPER, POOL, RELIEF_SCALE
from autonomy.grasp.quality import Jaws, jaws_of, rests_upon
from autonomy.grasp.sampling_planner import CRANE_SIGMA_M, CRANE_SIGMA_RAD
from autonomy.grasp.virtual_scene import CAMERA_HEIGHT_M, D435, SIDE_PX, operational_area, shortened_logs
from autonomy.perception.log_list import LogObservation
from sim.camera.scene import LogPose
from training.common.weight_file import Card, write
from training.grasp import network_training
from training.grasp.label_kernel import draw, facts_of, label
from training.grasp.network_training import LEARNING_RATE, GraspNetwork
from training.pictures.piles import CHUNK, HELD_OUT, piles, profile_of

# -- Training frames for the grasp network with physical labels: settled piles, the virtual camera, the label rule.
#
# The input is what the planner renders: logs as perfect, shortened cylinders seen from 3 m above.  The labels are
# the probability that a grasp at a pixel holds, from samples of the errors of perception and crane, and the closing
# direction.  This rule never evaluates an experiment (docs/reference/perception.md section 6).  Frames are at the
# network's own 100 x 100.


LOW_PX: Final = SIDE_PX // POOL
GRID_PX: Final = 4
"""Labels are computed at every fourth pixel of the 100 x 100 and interpolated."""
DRAWS: Final = 8
TURN_OFFSETS_RAD: Final = np.radians([-10.0, 0.0, 10.0])
MAX_LOG_DISTANCE_M: Final = 0.45
FRAMES_PER_PILE: Final = 20
"""Frames of one pile, each with other logs removed and another position of the camera."""
CAMERA_SHIFT_M: Final = 0.25


@dataclass(frozen=True, slots=True)
class GraspFrame:
    """Network input ``low`` (100, 100) float32 and labels (3, 100, 100).

    The labels are quality, quality times cos 2 theta, and quality times sin 2 theta.  Only the ratio of the last two is
    meaningful; in the paper they are zero outside the rectangles.
    """

    low: np.ndarray
    labels: np.ndarray


def cylinders_of(logs: Sequence[LogPose]) -> Cylinders:
    """Convert settled logs to cylinders."""
    return Cylinders(
        np.array([log.position_m for log in logs], float),
        np.array([log.axis for log in logs]),
        np.array([log.length_m for log in logs]),
        np.array([log.diameter_m for log in logs]) / 2.0,
    )


def frames(
    pile: Sequence[LogPose], ground_z_m: float, jaws: Jaws, seed: int, count: int = FRAMES_PER_PILE
) -> Iterator[GraspFrame]:
    """Draw ``count`` frames of one pile; deterministic."""
    rng = np.random.default_rng([seed, 7])
    facts = facts_of(jaws)
    whole = cylinders_of(pile)
    sigma = default_covariance(LogObservation(0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 2.6, 0.2))
    for k in range(count):
        keep = rng.random(whole.count) < rng.choice([1.0, 0.8, 0.5])
        keep[rng.integers(whole.count)] = True
        world = Cylinders(whole.center[keep], whole.axis[keep], whole.length[keep], whole.radius[keep])
        yield frame(_rotated(world, rng.uniform(-np.pi, np.pi)), ground_z_m, jaws, facts, sigma, rng, k)


def frame(
    world: Cylinders,
    ground_z_m: float,
    jaws: Jaws,
    facts: tuple[np.ndarray, np.ndarray],
    sigma: np.ndarray,
    rng: np.random.Generator,
    seed: int,
) -> GraspFrame:
    """Draw one frame of a world."""
    recreated = shortened_logs(world, jaws.blade_m)
    shift_m = rng.uniform(-CAMERA_SHIFT_M, CAMERA_SHIFT_M, 3)
    eye = operational_area(recreated).centroid_m + shift_m + np.array([0.0, 0.0, CAMERA_HEIGHT_M])
    pin = D435.scaled(1.0 / POOL)
    lens = (pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px)
    below = eye[2] - ground_z_m
    inverse = np.full((LOW_PX, LOW_PX), 1.0 / below)
    owner = np.full((LOW_PX, LOW_PX), -1, np.int16)
    draw(inverse, owner, _packed(recreated), eye, *lens)
    out = np.zeros((3, LOW_PX // GRID_PX, LOW_PX // GRID_PX))
    drawn = sample_cylinders(world, np.broadcast_to(sigma, (world.count, *sigma.shape)), DRAWS, seed)
    moves = rng.standard_normal((DRAWS, 4)) * (CRANE_SIGMA_M[0], CRANE_SIGMA_M[1], CRANE_SIGMA_RAD, CRANE_SIGMA_M[2])
    worlds = np.concatenate([_packed(world)[None], _packed(drawn)])
    levels = np.unique(np.round(np.append(world.center[:, 2] + world.radius, ground_z_m), 2))
    label(
        *facts,
        worlds,
        rests_upon(world),
        moves,
        levels,
        eye,
        inverse,
        *lens,
        GRID_PX,
        TURN_OFFSETS_RAD,
        MAX_LOG_DISTANCE_M,
        out,
    )
    # Without a grasp there is no direction to learn, and its error would dominate the quality in eq. 5.
    out[1:] *= out[0]
    # As ``network.normalized_relief``, with a known level ground.
    low = np.arcsinh(np.clip(1.0 - 1.0 / (inverse * below), -MAX_RELIEF, MAX_RELIEF) / RELIEF_SCALE).astype(np.float32)
    return GraspFrame(low, _interpolated_labels(out))


def _packed(world: Cylinders) -> np.ndarray:
    return np.concatenate([world.center, world.axis, world.length[..., None], world.radius[..., None]], axis=-1)


def _rotated(world: Cylinders, yaw: float) -> Cylinders:
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    middle = world.center.mean(axis=0) * (1.0, 1.0, 0.0)
    return Cylinders((world.center - middle) @ turn.T, world.axis @ turn.T, world.length, world.radius)


def _interpolation_matrix() -> np.ndarray:
    """Compute the linear interpolation (100, 25) from the grid to all pixels along one side, constant beyond its
    ends."""
    at = np.clip((np.arange(LOW_PX) - GRID_PX // 2) / GRID_PX, 0.0, LOW_PX // GRID_PX - 1.0)
    eye = np.eye(LOW_PX // GRID_PX)
    return np.stack([np.interp(at, np.arange(len(eye)), row) for row in eye], axis=1).astype(np.float32)


_UP: Final = _interpolation_matrix()


def _interpolated_labels(grid: np.ndarray) -> np.ndarray:
    labels: np.ndarray = _UP @ grid.astype(np.float32) @ _UP.T
    return labels


# -- Paper A's network trained on physical labels of settled piles instead of Cornell rectangles


MACHINE: Final = "palms_471"
FRAMES, EPOCHS, BATCH = 4000, 4, 8
TEST_FRAMES: Final = 200
"""Frames of held-out piles for the figure of the card."""


def drawn_frames(
    count: int, seed: int, first_chunk: int = 0, folder: Path | None = None, tick: Callable[[], None] = lambda: None
) -> list[GraspFrame]:
    """Draw ``count`` frames, ``FRAMES_PER_PILE`` of each pile; only piles on flat ground outside the bunk are used."""
    profile, grasp_frames = profile_of(MACHINE), list[GraspFrame]()
    jaws, ground = jaws_of(profile), profile.workspace.ground_z_m
    chunks = 1 + count // (FRAMES_PER_PILE * CHUNK // 2)
    while len(grasp_frames) < count:
        for pile in piles(MACHINE, first_chunk, chunks, folder):
            if pile.terrain == "flat" and pile.kind != "bunk" and len(grasp_frames) < count:
                frame_count = min(FRAMES_PER_PILE, count - len(grasp_frames))
                grasp_frames.extend(frames(pile.logs, ground, jaws, seed + pile.number, frame_count))
                tick()
        first_chunk += chunks
    return grasp_frames


def examples_of(found: list[GraspFrame]) -> list[network_training.Example]:
    """Make examples for eq. 5 from frames; the labels of all 90 000 pixels are interpolated."""
    up = network_training.upsampling()
    square = up.T @ up
    out = []
    for i, frame in enumerate(found):
        projected = square @ frame.labels @ square
        squared = float(np.sum(frame.labels * projected))
        out.append(network_training.Example(i, frame.low, (), projected.astype(np.float32), squared))
    return out


def quality_share(net: GraspNetwork, found: list[GraspFrame]) -> float:
    """Compute the mean ratio of the label's quality at the network's best pixel to the best quality in the frame."""
    maps = network_training.predict(net, examples_of(found))
    shares = []
    for grasp_map, frame in zip(maps, found, strict=True):
        best = float(frame.labels[0].max())
        if best > 0.0:
            shares.append(float(frame.labels[0].flat[int(np.argmax(grasp_map.q))]) / best)
    return float(np.mean(shares)) if shares else 0.0


def produce(
    seed: int, out: Path, console: Console, count: int = FRAMES, epochs: int = EPOCHS, folder: Path | None = None
) -> tuple[Path, Path]:
    """Draw frames, train, and write weights and card; an interrupted run continues.  Return both paths."""
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("drawing frames", total=-(-count // FRAMES_PER_PILE))
        grasp_frames = drawn_frames(count, seed, 0, folder, lambda: progress.advance(task))
    checkpoint = out.with_suffix(".checkpoint")
    title = "grasp network, physical labels"
    net, losses = network_training.train_network(
        examples_of(grasp_frames), seed, title, console, checkpoint, epochs=epochs, batch=BATCH
    )
    share = quality_share(net, drawn_frames(TEST_FRAMES, seed + 1, HELD_OUT, folder))
    card = Card(
        "Paper A's grasp network on physical labels",
        "Depth picture in, grasp quality and closing direction at every pixel out (paper A, Table I).",
        f"{count} frames of settled piles of logs seen by the virtual camera, labelled by the rule of "
        "autonomy.grasp.quality; no real data",
        f"{epochs} epochs, batches of {BATCH}, AdamW with {LEARNING_RATE} and a cosine, products in bf16; eq. 5",
        seed,
        {
            "loss (eq. 5), mean of the last 100 steps": f"{np.mean(losses[-100:]):.4f}",
            "label's quality at the chosen pixel over the best in the frame, held-out piles": f"{share:.3f}",
        },
        "anything but the virtual depth picture of logs as cylinders on level ground",
        f"timberhand train grasp --labels physical --seed {seed} --epochs {epochs} --out {out.name}",
    )
    return out, write(out, net, PAPER, card, {"frames": str(count)})
