"""Paper A's virtual scene (II-C): the logs recreated as perfect cylinders, and a depth camera above them.

Logs are shortened by the grapple's width and a further 10 %, so that no grasp is planned at their edges.  The cuboid of
their ends (eq. 1) bounds them; a D435 looks down from 3 m above its centroid.  The paper's scene is blank; here it
contains the ground, which a network needs to see relief.  Exact, no noise.  Base frame, metres; image: x right is
base +x, y down is base -y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.grasp.cylinders import Cylinders
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused

SIDE_PX: Final = 300
"""Side of the image the network takes, cut from the middle of the camera's."""
D435: Final = Intrinsics(640, 480, 385.0, 385.0, 320.0, 240.0).crop(170, 90, SIDE_PX, SIDE_PX)
CAMERA_HEIGHT_M: Final = 3.0
TRIM_SHARE: Final = 0.10
DOWNWARD_AXES: Final = np.diag([1.0, -1.0, -1.0])
"""Columns: the optical axes of a camera that looks straight down."""
MIN_DEPTH_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class OperationalArea:
    """The cuboid that holds the ends of all logs: least and greatest corner (3,) [m]."""

    low_m: np.ndarray
    high_m: np.ndarray

    @property
    def centroid_m(self) -> np.ndarray:
        """Its middle (3,)."""
        middle: np.ndarray = (self.low_m + self.high_m) / 2.0
        return middle


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole that looks straight down from a point (3,) [m]."""

    position_m: np.ndarray
    intrinsics: Intrinsics = D435

    def to_base(self, u_px: float, v_px: float, depth_m: float) -> np.ndarray:
        """Compute the base-frame point (3,) of a pixel at a depth [m]."""
        offset_m = DOWNWARD_AXES @ self.intrinsics.deproject(u_px, v_px, depth_m)
        point: np.ndarray = self.position_m + offset_m
        return point


def shortened_logs(world: Cylinders, grapple_m: float) -> Cylinders:
    """Recreate the logs: shorter by the grapple's width, then by 10 %."""
    return world.shortened(grapple_m, TRIM_SHARE)


def operational_area(world: Cylinders) -> OperationalArea:
    """Compute the operational area, from the ends of the axes (eq. 1).

    Raises:
        InputRefused: there is no log, or a pose is not finite.
    """
    ends = world.ends().reshape(-1, 3)
    if not len(ends) or not np.all(np.isfinite(ends)):
        raise InputRefused("grasp.scene-empty", "the virtual scene holds no log, or one whose pose is not finite")
    return OperationalArea(ends.min(axis=0), ends.max(axis=0))


def camera_above(box: OperationalArea, intrinsics: Intrinsics = D435) -> Camera:
    """Place the paper's camera: 3 m above the centroid."""
    return Camera(box.centroid_m + np.array([0.0, 0.0, CAMERA_HEIGHT_M]), intrinsics)


def cameras_along(
    box: OperationalArea, reach_m: float, count: int, intrinsics: Intrinsics = D435
) -> tuple[Camera, ...]:
    """Place a moving camera: ``count`` places on a circle of ``reach_m`` about the paper's place, which comes first."""
    first_camera = camera_above(box, intrinsics)
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[: max(0, count - 1)]
    circle = reach_m * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    return (first_camera, *(Camera(first_camera.position_m + step, intrinsics) for step in circle))


def render(world: Cylinders, camera: Camera, ground_z_m: float) -> np.ndarray:
    """Render the depth (H, W) float32 [m], optical z, of cylinders and level ground.

    Raises:
        InputRefused: the camera is not above the ground, or is inside a log.
    """
    pin = camera.intrinsics
    below = float(camera.position_m[2]) - ground_z_m
    if not below > MIN_DEPTH_M:
        raise InputRefused(
            "grasp.camera-below-ground", f"the virtual camera is {below:.2f} m above the ground; place it higher"
        )
    inverse = np.full((pin.height_px, pin.width_px), 1.0 / below, np.float32)
    u = ((np.arange(pin.width_px) - pin.cx_px) / pin.fx_px).astype(np.float32)
    v = ((np.arange(pin.height_px) - pin.cy_px) / pin.fy_px).astype(np.float32)
    centers, axes = (world.center - camera.position_m) @ DOWNWARD_AXES, world.axis @ DOWNWARD_AXES
    for p, w, length, radius in zip(centers, axes, world.length.tolist(), world.radius.tolist(), strict=True):
        _draw(inverse, u, v, pin, p, w, length / 2.0, radius)
    return 1.0 / inverse


def _draw(
    inverse: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    pin: Intrinsics,
    p: np.ndarray,
    w: np.ndarray,
    half: float,
    r: float,
) -> None:
    """Draw one cylinder into an image of inverse depths, within its bounding box."""
    side = np.cross(w, (0.0, 0.0, 1.0) if abs(w[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    across = np.stack([side, np.cross(w, side)]) * r
    corners = [p + a * half * w + b * across[0] + c * across[1] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    corners_m = np.array(corners)
    if corners_m[:, 2].min() < MIN_DEPTH_M:
        raise InputRefused("grasp.camera-in-log", "the virtual camera is inside a log or beside one; raise it")
    px = pin.project(corners_m)
    left, top = np.maximum(np.floor(px.min(axis=0)).astype(int), 0)
    right, bottom = np.ceil(px.max(axis=0)).astype(int) + 1
    box = (slice(top, max(top, bottom)), slice(left, max(left, right)))
    s_old, u, v = inverse[box], u[None, left : max(left, right)], v[top : max(top, bottom), None]
    if not s_old.size:
        return
    f = np.float32
    pw = float(p @ w)
    c = f(p @ p - pw * pw - r * r)
    b = f(p[0] - pw * w[0]) * u + (f(p[1] - pw * w[1]) * v + f(p[2] - pw * w[2]))
    dw = f(w[0]) * u + (f(w[1]) * v + f(w[2]))
    disc = b * b
    disc -= c * (u * u + (v * v + f(1.0)))
    disc += c * (dw * dw)
    s = (b + np.sqrt(np.maximum(disc, f(0.0)))) / c
    hit = (disc > 0.0) & (s > s_old) & (np.abs(dw - s * f(pw)) <= s * f(half))
    np.copyto(s_old, s, where=hit)
    for sign in (-1.0, 1.0):
        end = p + sign * half * w
        away = sign * float(w @ end)
        if away >= 0.0:
            continue
        s = dw * f(sign / away)
        dx, dy, dz = u - s * f(end[0]), v - s * f(end[1]), f(1.0) - s * f(end[2])
        hit = (dx * dx + dy * dy + dz * dz <= f(r * r) * s * s) & (s > s_old)
        np.copyto(s_old, s, where=hit)
