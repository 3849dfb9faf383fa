"""Training frames: the compiled rule and camera against the planner's own, and equal seeds."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from autonomy.grasp.cylinders import Cylinders
from autonomy.grasp.network import GraspNet
from autonomy.grasp.quality import blade_sections, jaws_of, rests_upon, score_grasps
from autonomy.grasp.virtual_scene import DOWNWARD_AXES, Camera, render
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile
from sim.camera.geometry import View
from sim.camera.render import render as sim_render
from sim.camera.scene import Ground, LogPose, SceneBuilder
from tests.codes import numbers_in
from timberhand.commands import train
from training.grasp.label_kernel import draw, evaluate_candidate, facts_of
from training.grasp.physical_weights import LOW_PX, frames
from training.pictures.piles import Pile

GROUND = -1.39
JAWS = jaws_of(load_profile("palms_471"))


def world(seed: int, count: int = 5) -> Cylinders:
    rng = np.random.default_rng(seed)
    yaw, slope = rng.normal(0.3, 0.2, count), rng.normal(0.0, 0.05, count)
    axis = np.stack([np.cos(yaw), np.sin(yaw), slope], axis=1)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    radius = rng.uniform(0.05, 0.15, count)
    low = rng.choice([0.0, 0.0, 0.2], count)
    center = np.stack([rng.normal(0, 0.2, count), rng.normal(0, 0.35, count), GROUND + low + radius], axis=1)
    return Cylinders(center, axis, rng.uniform(2.0, 2.8, count), radius)


def packed(w: Cylinders) -> np.ndarray:
    return np.concatenate([w.center, w.axis, w.length[:, None], w.radius[:, None]], axis=1)


def poses(w: Cylinders) -> list[LogPose]:
    found = []
    for i in range(w.count):
        a = w.axis[i]
        q = np.append(np.cross((0.0, 0.0, 1.0), a), 1.0 + a[2])
        q /= np.linalg.norm(q)
        found.append(LogPose(i + 1, tuple(w.center[i]), tuple(q), float(w.length[i]), 2.0 * float(w.radius[i])))
    return found


@pytest.mark.long
def test_the_virtual_camera_sees_what_the_simulations_renderer_sees() -> None:
    w = world(1)
    camera = Camera(np.array([0.0, 0.0, GROUND + 3.1]))
    scene = SceneBuilder(Ground.flat(GROUND))
    for log in poses(w):
        scene.log(log)
    theirs = sim_render(scene.build(), View(camera.intrinsics, camera.position_m, DOWNWARD_AXES)).depth_m
    ours = render(w, camera, GROUND)
    assert np.quantile(np.abs(ours - theirs), 0.999) < 1e-3
    assert np.mean(np.abs(ours - theirs) > 0.01) < 1e-3


def test_the_compiled_camera_is_the_planners() -> None:
    w = world(2)
    camera = Camera(np.array([0.1, -0.1, GROUND + 3.0]))
    pin = camera.intrinsics
    inverse = np.full((300, 300), 1.0 / 3.0)
    lens = (pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px)
    draw(inverse, np.zeros((300, 300), np.int16), packed(w), camera.position_m, *lens)
    away = np.abs(1.0 / inverse - render(w, camera, GROUND))
    assert np.quantile(away, 0.999) < 1e-3


def test_the_compiled_rule_is_the_planners() -> None:
    rng, facts = np.random.default_rng(5), facts_of(JAWS)
    safe = 0
    for seed in range(30):
        w = world(seed, 1 + seed % 5)
        upon = rests_upon(w)
        x, y = rng.normal(0, 0.3, 40), rng.normal(0, 0.3, 40)
        yaw = rng.normal(0.3, 0.2, 40) + math.pi / 2
        level = rng.choice([GROUND, *(w.center[:, 2] + w.radius)], 40)
        ours = score_grasps(JAWS, w, upon, blade_sections(JAWS, w, x, y, yaw), level)
        for k in range(40):
            at, captured = np.empty((w.count, 3)), np.empty(w.count, np.bool_)
            lever, mass = evaluate_candidate(*facts, packed(w), upon, x[k], y[k], yaw[k], level[k], at, captured)
            assert (lever > 0.0) == ours.safe[k], (seed, k)
            if ours.safe[k]:
                safe += 1
                assert captured.tolist() == ours.captured[k].tolist()
                assert mass == pytest.approx(ours.mass_kg[k]) and lever <= ours.balance[k] + 1e-9
    assert safe > 50


def test_a_frame_is_a_picture_with_quality_on_the_wood_and_equal_seeds_are_equal() -> None:
    single = [LogPose(1, (0.3, 0.2, GROUND + 0.1), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), 2.6, 0.2)]
    first, again = (list(frames(single, GROUND, JAWS, 3, 4)) for _ in range(2))
    other = next(frames(single, GROUND, JAWS, 4, 1))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a.low, b.low) and np.array_equal(a.labels, b.labels)
    frame = first[0]
    assert frame.low.shape == (LOW_PX, LOW_PX) and frame.labels.shape == (3, LOW_PX, LOW_PX)
    assert not np.array_equal(other.low, frame.low)
    v, u = np.unravel_index(np.argmax(frame.labels[0]), (LOW_PX, LOW_PX))
    assert np.all(np.hypot(frame.labels[1], frame.labels[2]) < frame.labels[0] + 1e-6), "no grasp, no direction"
    assert frame.labels[0].max() > 0.8 and frame.low[v, u] > 1.0, "the best place is on the log"
    rows, columns = np.nonzero(frame.low > 1.0)
    along = np.linalg.svd(np.stack([columns - columns.mean(), rows - rows.mean()]))[0][:, 0]
    theta = 0.5 * math.atan2(frame.labels[2, v, u], frame.labels[1, v, u])
    assert abs(math.cos(theta) * along[0] + math.sin(theta) * along[1]) < 0.25, "the jaws close across it"


def test_frames_become_examples_of_equation_5() -> None:
    """Against the sums over all 90 000 pixels."""
    torch = pytest.importorskip("torch")
    from training.grasp.network_training import equation_5, upsampling
    from training.grasp.physical_weights import examples_of

    single = [LogPose(1, (0.3, 0.2, GROUND + 0.1), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), 2.6, 0.2)]
    found = list(frames(single, GROUND, JAWS, 3, 2))
    made, up = examples_of(found), upsampling()
    maps = np.random.default_rng(1).normal(0.0, 0.3, (2, 3, LOW_PX, LOW_PX)).astype(np.float32)
    explicit = (
        np.mean([np.sum((up @ m @ up.T - up @ f.labels @ up.T) ** 2) for m, f in zip(maps, found, strict=True)])
        / len(up) ** 2
    )
    projected, square = torch.tensor(np.stack([e.projected for e in made])), torch.tensor([e.square for e in made])
    loss = equation_5(torch.from_numpy(maps), projected, square, torch.from_numpy(up.T @ up))
    assert float(loss) == pytest.approx(explicit, rel=1e-4)


@pytest.mark.long
def test_weights_from_physical_labels_come_with_their_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    from training.grasp import physical_weights

    def lain(machine: str, first: int, count: int, folder: Path | None) -> list[Pile]:
        z = GROUND + 0.1
        logs = tuple(
            LogPose(i + 1, (0.3, y, z), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)), 2.6, 0.2)
            for i, y in enumerate((0.2, 0.42))
        )
        return [Pile(machine, first, "parallel", "flat", 0, GROUND, logs)]

    monkeypatch.setattr(physical_weights, "piles", lain)
    monkeypatch.setattr(physical_weights, "TEST_FRAMES", 4)
    out = tmp_path / "grasp_physical.onnx"
    made, card = physical_weights.produce(3, out, Console(quiet=True), count=8, epochs=1)
    assert made == out and GraspNet(out).maps(np.full((300, 300), 3.0, np.float32)).q.shape[0] > 0
    told = card.read_text()
    assert 8 in numbers_in(told)
    assert "timberhand train grasp --labels physical --seed 3 --epochs 1 --out grasp_physical.onnx" in told


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["grasp"], "train.data-missing"),
        (["grasp", "--labels", "physical", "--data", "."], "train.data-not-wanted"),
    ],
)
def test_which_labels_need_data(arguments: list[str], code: str) -> None:
    pytest.importorskip("torch")
    done = CliRunner().invoke(train.app, arguments)
    assert isinstance(done.exception, CommandFailed) and done.exception.exit_code == ExitCode.USAGE
    assert done.exception.code == code
