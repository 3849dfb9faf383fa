"""The picture of a network's plan: depth and quality with the grasp, one for each plan, and never a reason to stop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from autonomy.grasp.cnn_planner import GAP_PX, GRASP_RGB, QUALITY_RGB, ZOOM, CnnPlanner, write_plan
from autonomy.grasp.network import PixelGrasp
from autonomy.grasp.planner import GraspRequest
from tests.autonomy.grasp_scenes import ARM, Chosen, pair

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
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    last = planner(request)
    for plan in (*plans, last):
        assert (plan.x_m, plan.y_m, plan.yaw_rad, plan.support_z_m) == (
            plain.x_m,
            plain.y_m,
            plain.yaw_rad,
            plain.support_z_m,
        )
    assert "plan-003.png" in last.reason and last.reason != plans[0].reason
