"""Paper A's virtual world, the planner that looks through it, the picture of its plan, and planners by name."""

from __future__ import annotations

import shutil
from dataclasses import replace
from math import cos, hypot, pi, remainder, sin
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from autonomy.grasp import planners
from autonomy.grasp.cnn_planner import GAP_PX, GRASP_RGB, QUALITY_RGB, ZOOM, CnnPlanner, mean_maps, write_plan
from autonomy.grasp.cylinders import as_cylinders
from autonomy.grasp.network import WEIGHTS, GraspMaps, GraspNet, PixelGrasp
from autonomy.grasp.planner import GraspRequest, NoGrasp
from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from autonomy.grasp.quality import jaws_of
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.virtual_scene import Camera, camera_above, cameras_along, operational_area, render, shortened_logs
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from autonomy.process.command_line import arguments
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused
from tests.autonomy.grasp_scenes import ARM, GROUND, PROFILE, Chosen, X, Y, cross, log, pair, small_pile
from tests.codes import coded

JAWS = jaws_of(PROFILE)


def test_logs_are_shortened_by_the_grapple_and_a_tenth_but_never_to_discs() -> None:
    world = as_cylinders(pair())
    assert shortened_logs(world, 0.36).length == pytest.approx([(2.6 - 0.36) * 0.9] * 2)
    assert shortened_logs(world, 2.5).length == pytest.approx([0.2, 0.2])
    assert np.array_equal(shortened_logs(world, 0.36).center, world.center)


def test_the_cuboid_holds_the_ends_and_the_camera_hangs_three_metres_over_its_middle() -> None:
    turned = log(0, yaw=0.5)
    box = operational_area(as_cylinders([turned]))
    half = np.array([1.3 * cos(0.5), 1.3 * sin(0.5), 0.0])
    assert box.low_m == pytest.approx(np.array(turned.center_m) - half)
    assert box.high_m == pytest.approx(np.array(turned.center_m) + half)
    assert camera_above(box).position_m == pytest.approx((*turned.center_m[:2], turned.center_m[2] + 3.0))
    with pytest.raises(InputRefused, check=coded("grasp.scene-empty")):
        operational_area(as_cylinders([]))


@settings(max_examples=40, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-pi, pi), st.floats(0.1, 0.3), st.floats(-0.2, 0.2))
def test_depth_is_that_of_the_surface(dx: float, dy: float, yaw: float, diameter: float, slope: float) -> None:
    """Every pixel's point lies on the cylinder's side or caps, or on the ground."""
    one = log(0, dy, 0.2, yaw, diameter, dx)
    world = as_cylinders([one])
    world.axis[0, 2] = slope
    world.axis[0] /= np.linalg.norm(world.axis[0])
    camera = Camera(np.array([X, Y, GROUND + 3.0]))
    depth = render(world, camera, GROUND)
    v, u = np.mgrid[0:300:7, 0:300:7]
    z = depth[v, u].astype(float)
    pin = camera.intrinsics
    points = camera.position_m + np.stack(
        [(u - pin.cx_px) / pin.fx_px * z, -(v - pin.cy_px) / pin.fy_px * z, -z], axis=-1
    )
    away = points - world.center[0]
    along = away @ world.axis[0]
    off = np.linalg.norm(away - along[..., None] * world.axis[0], axis=-1)
    side = (np.abs(off - diameter / 2) < 2e-3) & (np.abs(along) < 1.301)
    cap = (np.abs(np.abs(along) - 1.3) < 2e-3) & (off < diameter / 2 + 2e-3)
    ground = np.abs(points[..., 2] - GROUND) < 1e-4
    assert np.all(side | cap | ground)
    inside = (np.abs(along) < 1.298) & (off < diameter / 2 - 2e-3)
    assert not inside.any()


def test_a_log_fills_the_pixels_it_should() -> None:
    camera = Camera(np.array([X, Y, GROUND + 3.0]))
    depth = render(as_cylinders([log(0, diameter=0.2)]), camera, GROUND)
    assert depth.min() == pytest.approx(2.8, abs=1e-3)
    rows, columns = np.nonzero(depth < 2.95)
    assert columns.min() == 0 and columns.max() == 299, "longer than the picture is wide"
    assert np.ptp(rows) == pytest.approx(0.2 / 2.9 * 385, abs=2)


def test_a_camera_that_cannot_see_is_refused() -> None:
    with pytest.raises(InputRefused, check=coded("grasp.camera-below-ground")):
        render(as_cylinders(pair()), Camera(np.array([X, Y, GROUND])), GROUND)
    with pytest.raises(InputRefused, check=coded("grasp.camera-in-log")):
        render(as_cylinders(pair()), Camera(np.array([X, Y, GROUND + 0.2])), GROUND)


@pytest.mark.parametrize("theta", [0.3, -1.2])
def test_a_pixel_becomes_a_grasp_in_the_base(theta: float) -> None:
    """Right in the picture is base +x, up is base +y; the closing direction turns with it."""
    planner = CnnPlanner(Chosen(180.0, 90.0, theta))
    one = log(0, 0.0)
    p = planner(GraspRequest(ARM, [one], 0.0))
    seen = planner.view(as_cylinders([one]), JAWS, GROUND)
    z = float(seen.depth_m[90, 180])
    assert (p.x_m, p.y_m) == pytest.approx((X + 30 / 385 * z, Y + 60 / 385 * z))
    assert remainder(p.yaw_rad + theta, pi) == pytest.approx(0.0)
    assert p.logs == (0,) and p.support_z_m == pytest.approx(GROUND)


def test_the_tips_go_a_hand_under_the_surface_of_a_pile() -> None:
    pile = [*small_pile(), log(3, 0.0, 0.38)]
    p = CnnPlanner(Chosen(150.0, 150.0, pi / 2))(GraspRequest(ARM, pile, 0.0))
    assert p.support_z_m == pytest.approx(GROUND + 0.58 - 0.25, abs=0.01) and 3 in p.logs


def test_with_physical_labels_the_height_is_that_of_the_rule() -> None:
    def height(logs: list, by_rule: bool) -> float:
        return CnnPlanner(Chosen(150.0, 150.0, pi / 2), by_rule)(GraspRequest(ARM, logs, 0.0)).support_z_m

    assert height(small_pile(), True) == pytest.approx(GROUND)
    assert height(small_pile(), False) == pytest.approx(GROUND + 0.38 - 0.25, abs=0.01)
    aside = [log(0, 0.6)]
    assert height(aside, True) == height(aside, False) == pytest.approx(GROUND), "where no grasp is safe"


@pytest.mark.parametrize("yaw", [-0.8, 0.0, 0.8])
def test_the_shipped_weights_from_physical_labels_close_across_a_log_near_its_middle(yaw: float) -> None:
    net = GraspNet(WEIGHTS.with_name("grasp_physical.onnx"))
    p = CnnPlanner(net, by_rule=True)(GraspRequest(ARM, [log(0, yaw=yaw, diameter=0.24)], 0.0))
    assert p.logs == (0,) and hypot(p.x_m - X, p.y_m - Y) < 0.6, "on a log of 2.6 m"
    assert abs(remainder(p.yaw_rad - yaw - pi / 2, pi)) < 0.25


def test_on_wheels_the_lowest_log_gives_the_ground() -> None:
    arm = Arm(load_profile("aoro_fc8"))
    x, y = arm.profile.workspace.pick_center_m
    one = LogObservation(0, (x, y, arm.profile.workspace.ground_z_m + 0.2), (1.0, 0.0, 0.0), 2.6, 0.2)
    p = CnnPlanner(Chosen(150.0, 150.0, pi / 2))(GraspRequest(arm, [one], 0.0))
    assert p.support_z_m == pytest.approx(one.center_m[2] - 0.1)


def test_a_moving_camera_agrees_with_one_that_stands() -> None:
    planner = CnnPlanner(Chosen(0.0, 0.0, 0.0), cameras=5)
    seen = planner.view(as_cylinders(cross()), JAWS, GROUND)
    point = seen.camera.to_base(seen.best.u_px, seen.best.v_px, 2.6)
    assert abs(remainder(seen.best.theta_rad - pi / 2, pi)) < 1e-6
    upper = cross()[2]
    off = (point[:2] - upper.center_m[:2]) @ np.array([-upper.axis[1], upper.axis[0]])
    assert abs(off) < 0.05, "the mean is highest on the topmost log"


def test_predictions_are_averaged_where_they_belong() -> None:
    box = operational_area(as_cylinders(pair()))
    cameras = cameras_along(box, 0.3, 4)
    maps = []
    for camera in cameras:
        q = np.zeros((300, 300))
        seen = (box.centroid_m - camera.position_m) * np.array([1.0, -1.0, -1.0])
        u, v = camera.intrinsics.project(seen[None])[0].round().astype(int)
        q[v, u] = 1.0
        maps.append(GraspMaps(q, q, q))
    mean = mean_maps(maps, cameras, float(box.centroid_m[2]))
    assert mean.q[149:152, 149:152].sum() == pytest.approx(1.0) and mean.q[150, 150] >= 0.25


def test_the_network_plans_as_if_logs_that_must_stay_were_not_there() -> None:
    logs = [log(0, -0.4), log(1), log(2, 0.4)]
    planner = CnnPlanner(Chosen(150.0, 150.0, pi / 2))
    without = planner(GraspRequest(ARM, [logs[1]], 0.0))
    p = planner(GraspRequest(ARM, logs, 0.0, stay={0, 2}))
    assert p.logs == (1,) and (p.x_m, p.y_m) == (without.x_m, without.y_m)
    with pytest.raises(NoGrasp, check=coded("grasp.no-log-in-view")):
        planner(GraspRequest(ARM, logs, 0.0, stay=range(3)))


# -- the picture of a plan
SIDE_PX = 300


def test_the_near_is_bright_the_best_is_yellow_and_the_grasp_is_drawn_in_both(tmp_path: Path) -> None:
    depth_m, quality = np.full((SIDE_PX, SIDE_PX), 3.0), np.zeros((100, 100))
    depth_m[:150] = 2.0
    quality[:, :50] = 1.0
    write_plan(tmp_path / "plan.png", depth_m, quality, PixelGrasp(200.0, 220.0, 0.0, 1.0), 60.0)
    picture = np.asarray(Image.open(tmp_path / "plan.png"))
    right = ZOOM * SIDE_PX + GAP_PX
    assert picture.shape == (ZOOM * SIDE_PX, 2 * ZOOM * SIDE_PX + GAP_PX, 3)
    assert tuple(picture[10, 10]) == (255, 255, 255) and tuple(picture[-10, 10]) == (0, 0, 0)
    assert tuple(picture[10, right + 10]) == QUALITY_RGB[-1] and tuple(picture[10, -10]) == QUALITY_RGB[0]
    for left in (0, right):
        for side_px in (-30, 30):
            jaw = picture[ZOOM * 220 + 3, left + ZOOM * (200 + side_px)]
            assert tuple(jaw) == GRASP_RGB


def test_every_plan_has_its_picture_and_a_folder_that_is_gone_changes_no_plan(tmp_path: Path) -> None:
    folder = tmp_path / "plans"
    folder.mkdir()
    planner, request = CnnPlanner(Chosen(150.0, 150.0, 0.3), pictures=folder), GraspRequest(ARM, tuple(pair()), 0.0)
    plain = CnnPlanner(Chosen(150.0, 150.0, 0.3))(request)
    plans = [planner(request), planner(request)]
    assert [path.name for path in sorted(folder.iterdir())] == ["plan-001.png", "plan-002.png"]
    assert str(folder / "plan-002.png") in plans[1].reason
    shutil.rmtree(folder)
    last = planner(request)
    assert all(replace(plan, reason=plain.reason) == plain for plan in (*plans, last))
    assert "plan-003.png" in last.reason and last.reason != plans[0].reason


# -- planners by name
WORDS = ["--controller", "127.0.0.1:1", "--report-port", "2", "--scene", "127.0.0.1:3"]


@pytest.mark.parametrize(
    ("choice", "kind"),
    [
        (OUR_PLANNER, SamplingPlanner),
        (PlannerChoice("cnn"), CnnPlanner),
        (PlannerChoice("cnn-physical", 4), CnnPlanner),
        (PlannerChoice("cnn", 1, "."), CnnPlanner),
    ],
)
def test_a_name_makes_its_planner_and_reaches_the_planning_process(choice, kind):
    assert isinstance(choice.make(), kind)
    assert arguments([*WORDS, *choice.arguments()]).planner == choice


@pytest.mark.parametrize(
    ("choice", "code"),
    [
        (PlannerChoice("nobody"), "planner.unknown"),
        (PlannerChoice("search", 2), "planner.no-virtual-camera"),
        (PlannerChoice("search", 1, "."), "planner.no-pictures"),
        (PlannerChoice("cnn", 1, "no/such/folder"), "planner.no-folder"),
        (PlannerChoice("cnn", 0), "planner.virtual-cameras"),
        (PlannerChoice("cnn", planners.MAX_VIRTUAL_CAMERAS + 1), "planner.virtual-cameras"),
    ],
)
def test_what_no_planner_can_do_is_refused_before_anything_is_loaded(choice, code, capsys):
    with pytest.raises(InputRefused, check=coded(code)):
        choice.check()
    with pytest.raises(InputRefused, check=coded(code)):
        choice.make()
    words = ("--virtual-cameras", str(choice.virtual_cameras), "--plan-pictures", choice.pictures)
    with pytest.raises(SystemExit, match="2"):
        arguments([*WORDS, "--planner", choice.name, *words])


def test_a_planner_of_another_package_is_found_by_its_entry_point(monkeypatch):
    def entry_points(group, name=""):
        assert group == "timberhand.grasp_planners"
        return [SimpleNamespace(name="pca", load=lambda: SamplingPlanner)] if name in ("", "pca") else []

    monkeypatch.setattr("autonomy.grasp.planners.entry_points", entry_points)
    monkeypatch.setattr("runtime.plugins.entry_points", entry_points)
    assert isinstance(PlannerChoice("pca").make(), SamplingPlanner)
    with pytest.raises(InputRefused, check=coded("planner.no-virtual-camera")):
        PlannerChoice("pca", 2).check()
