"""Paper A's grasp planner (section II): virtual scene, depth image, network, argmax, and back to the base frame.

The network says where to grip and how the grapple is turned, not how deep: the tips go 0.25 m under the surface that
the camera sees there, as on the test-bed (docs/reference/machines.md section 1.5), and never into the ground.  The
logs between the jaws are named for the closing motion; the network does not predict what comes up.  Inputs: log list,
a network. Failure: ``NoGrasp``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from PIL import Image, ImageDraw

from autonomy.grasp.cylinders import Cylinders, as_cylinders, lowest_m
from autonomy.grasp.grapple_heights import known_ground_m
from autonomy.grasp.network import GraspMaps, PixelGrasp, best_pixel
from autonomy.grasp.planner import GraspCandidate, GraspRequest, NoGrasp
from autonomy.grasp.quality import Jaws, blade_sections, jaws_of, rests_upon, score_grasps
from autonomy.grasp.virtual_scene import Camera, camera_above, cameras_along, operational_area, render, shortened_logs
from runtime.errors import InputRefused

VIRTUAL_PATH_M: Final = 0.7
"""Radius of the virtual camera's path, which the paper does not state: the network's best pixel in a single picture is
often at an edge, and averages over half a metre and more agree on the middle of a log."""
TIP_DEPTH_M: Final = 0.25
"""Depth of the tips below the surface of the pile."""


class Network(Protocol):
    """Paper A's network, as ``GraspNet``: a 300 x 300 depth image [m] in, the grasp of eq. 4 or whole maps out."""

    def best(self, depth_m: np.ndarray) -> PixelGrasp: ...

    def maps(self, depth_m: np.ndarray) -> GraspMaps: ...


@dataclass(frozen=True, slots=True)
class NetworkView:
    """What a grasp was planned from, for plots: camera, depth (300, 300) [m] and the grasp found in it."""

    camera: Camera
    depth_m: np.ndarray
    best: PixelGrasp


class CnnPlanner:
    """A ``GraspPlanner``.  Like the paper's, it does not know logs that must stay: it plans from the list without them
    and may take one along.

    ``by_rule`` takes the height from the capture rule that also makes the physical labels, where that rule holds.
    ``cameras`` over 1 moves the virtual camera on a circle of ``reach_m`` and averages the predictions (II-C); the
    paper's results use one camera that stands still.  A grasp that is best from all sides is seldom at an edge.
    ``pictures``: a folder that gets a picture of every plan, that of the first camera.
    """

    def __init__(
        self,
        network: Network,
        by_rule: bool = False,
        cameras: int = 1,
        reach_m: float = VIRTUAL_PATH_M,
        pictures: Path | None = None,
    ) -> None:
        self._network, self._by_rule, self._cameras, self._reach_m = network, by_rule, cameras, reach_m
        self._pictures, self._planned = pictures, 0

    def view(self, world: Cylinders, jaws: Jaws, ground_z_m: float) -> NetworkView:
        """Render the virtual camera's image of a scene and find the grasp in it.

        Raises:
            InputRefused: there is no log to see, or the camera is not above the ground.
        """
        recreated = shortened_logs(world, jaws.blade_m)
        box = operational_area(recreated)
        if self._cameras <= 1:
            camera = camera_above(box)
            depth = render(recreated, camera, ground_z_m)
            return NetworkView(camera, depth, self._network.best(depth))
        views = cameras_along(box, self._reach_m, self._cameras)
        pictures = [render(recreated, camera, ground_z_m) for camera in views]
        mean = mean_maps([self._network.maps(depth) for depth in pictures], views, float(box.centroid_m[2]))
        return NetworkView(views[0], pictures[0], best_pixel(mean))

    def __call__(self, request: GraspRequest) -> GraspCandidate:
        """Return the grasp of eq. 4; raise ``NoGrasp`` without a log."""
        arm = request.arm
        free_indices = [i for i in range(len(request.logs)) if i not in request.stay]
        logs = [request.logs[i] for i in free_indices]
        if not logs:
            raise NoGrasp("grasp.no-log-in-view", "no log is in view")
        world, jaws = as_cylinders(logs), jaws_of(arm.profile)
        ground = known_ground_m(arm.profile)
        ground = ground if math.isfinite(ground) else lowest_m(world)
        try:
            network_view = self.view(world, jaws, ground)
        except InputRefused as error:
            raise NoGrasp("grasp.no-network-input", f"the network has nothing to plan from: {error}") from None
        pixel_grasp = network_view.best
        depth = float(network_view.depth_m[round(pixel_grasp.v_px), round(pixel_grasp.u_px)])
        x, y, surface = network_view.camera.to_base(pixel_grasp.u_px, pixel_grasp.v_px, depth).tolist()
        # Seen from above, the image's y axis points against the base's.
        yaw, level = -pixel_grasp.theta_rad, max(ground, surface - TIP_DEPTH_M)
        if self._by_rule:
            level = rule_level_m(jaws, world, x, y, yaw, ground, level)
        taken = tuple(free_indices[i] for i in logs_between_jaws(jaws, world, x, y, yaw, level))
        quality = min(max(pixel_grasp.q, 0.0), 1.0)
        reason = (
            f"the network's best pixel ({pixel_grasp.u_px:.0f}, {pixel_grasp.v_px:.0f}) has quality {pixel_grasp.q:.2f}"
        )
        if self._pictures is not None:
            reason += self._draw(network_view, 2.0 * jaws.half_gap_m * network_view.camera.intrinsics.fx_px / depth)
        return GraspCandidate(x, y, yaw, level, taken, quality, reason)

    def _draw(self, seen: NetworkView, opening_px: float) -> str:
        """Draw a plan and return what a reader of its reason is told, a full disk included."""
        assert self._pictures is not None
        self._planned += 1
        path = self._pictures / f"plan-{self._planned:03}.png"
        try:
            write_plan(path, seen.depth_m, self._network.maps(seen.depth_m).q, seen.best, opening_px)
        except OSError as error:
            return f"; {path} cannot be written: {error.strerror}"
        return f"; {path}"


def logs_between_jaws(jaws: Jaws, world: Cylinders, x: float, y: float, yaw: float, level: float) -> tuple[int, ...]:
    """Find the indices of the logs between the jaws of a grasp and above its tips; without any, of the nearest one."""
    at = blade_sections(jaws, world, np.array(x), np.array(y), np.array(yaw))
    middle = np.abs(at.low_u + at.high_u) / 2
    inside = at.inside & (middle < jaws.half_gap_m) & (at.middle > level)
    if not inside.any():
        off = np.linalg.norm(world.center[:, :2] - (x, y), axis=1)
        return (int(np.argmin(np.where(at.inside, middle, off + 10.0))),)
    return tuple(int(i) for i in np.flatnonzero(inside))


def rule_level_m(jaws: Jaws, world: Cylinders, x: float, y: float, yaw: float, ground: float, level: float) -> float:
    """Find the height at which the capture rule takes most wood at a place; ``level`` where it takes none."""
    heights = np.append(world.center[:, 2] + world.radius, ground)
    at = blade_sections(jaws, world, *(np.full(len(heights), v) for v in (x, y, yaw)))
    scores = score_grasps(jaws, world, rests_upon(world), at, heights)
    mass = np.where(scores.safe, scores.mass_kg, 0.0)
    return float(heights[np.argmax(mass)]) if mass.any() else level


def mean_maps(maps: Sequence[GraspMaps], cameras: Sequence[Camera], height_m: float) -> GraspMaps:
    """Average the predictions of cameras that look straight down, shifted onto the first camera's image at a height.

    Pixels that a camera does not see count as zero for it.
    """
    first_camera = cameras[0]
    sums = np.zeros((3, *maps[0].q.shape))
    for camera_maps, camera in zip(maps, cameras, strict=True):
        away = float(camera.position_m[2]) - height_m
        step = (camera.position_m - first_camera.position_m)[:2] / away / camera_maps.scale_px
        right, down = round(step[0] * camera.intrinsics.fx_px), round(-step[1] * camera.intrinsics.fy_px)
        for total, layer in zip(sums, (camera_maps.q, camera_maps.cos2, camera_maps.sin2), strict=True):
            total += _shifted(layer, down, right)
    sums /= len(maps)
    return GraspMaps(sums[0], sums[1], sums[2], maps[0].scale_px)


def _shifted(layer: np.ndarray, down: int, right: int) -> np.ndarray:
    """Move a map by whole entries, filled with zeros."""
    out = np.zeros_like(layer)
    height, width = layer.shape
    rows, columns = math.fabs(down), math.fabs(right)
    if rows < height and columns < width:
        to = (slice(max(0, down), height + min(0, down)), slice(max(0, right), width + min(0, right)))
        come = (slice(max(0, -down), height + min(0, -down)), slice(max(0, -right), width + min(0, -right)))
        out[to] = layer[come]
    return out


# -- A network's plan, as in Fig. 5 of paper A: the virtual depth picture and the quality map, with the grasp in both.

ZOOM: Final = 2
GAP_PX: Final = 8
QUALITY_RGB: Final = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
"""Colours of a quality of 0, 0.25, 0.5, 0.75 and 1 times the greatest one, which counts as 1 at least (viridis)."""
GRASP_RGB: Final = (226, 87, 58)
_JAW_SHARE: Final = 0.25
"""Half the width of a jaw, of half the opening."""


def write_plan(path: Path, depth_m: np.ndarray, quality: np.ndarray, grasp: PixelGrasp, opening_px: float) -> None:
    """Write a PNG: the depth (H, W) [m], near things bright, beside the quality (h, w) on the same square.

    ``opening_px``: opening of the grapple in pixels of the depth picture.

    Raises:
        OSError: the file cannot be written.
    """
    rows, columns = depth_m.shape
    near, far = float(np.nanmin(depth_m)), float(np.nanmax(depth_m))
    grey = 255.0 * (far - np.nan_to_num(depth_m, nan=far)) / max(far - near, 1e-6)
    anchors = np.linspace(0.0, max(1.0, float(np.max(quality))), len(QUALITY_RGB))
    coloured = np.stack([np.interp(quality, anchors, channel) for channel in np.transpose(QUALITY_RGB)], axis=-1)
    size = (ZOOM * columns, ZOOM * rows)
    sheet = Image.new("RGB", (2 * size[0] + GAP_PX, size[1]), "white")
    for left_px, picture in ((0, Image.fromarray(grey.astype(np.uint8))), (size[0] + GAP_PX, _rgb(coloured))):
        sheet.paste(picture.resize(size, Image.Resampling.NEAREST), (left_px, 0))
        _draw_grasp(ImageDraw.Draw(sheet), left_px, grasp, ZOOM * opening_px / 2.0)
    sheet.save(path, "PNG")


def _rgb(coloured: np.ndarray) -> Image.Image:
    return Image.fromarray(coloured.astype(np.uint8))


def _draw_grasp(draw: ImageDraw.ImageDraw, left_px: int, grasp: PixelGrasp, half_px: float) -> None:
    """Draw a dot in the middle, a thin line across the opening, a thick one for each jaw."""
    u, v = left_px + ZOOM * grasp.u_px, ZOOM * grasp.v_px
    c, s, wide_px = math.cos(grasp.theta_rad), math.sin(grasp.theta_rad), _JAW_SHARE * half_px
    draw.line([(u - half_px * c, v - half_px * s), (u + half_px * c, v + half_px * s)], GRASP_RGB, 1)
    for side_px in (-half_px, half_px):
        jaw_u, jaw_v = u + side_px * c, v + side_px * s
        ends = [(jaw_u + wide_px * s, jaw_v - wide_px * c), (jaw_u - wide_px * s, jaw_v + wide_px * c)]
        draw.line(ends, GRASP_RGB, 4)
    draw.ellipse([u - 4, v - 4, u + 4, v + 4], GRASP_RGB, "white")
