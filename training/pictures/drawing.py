"""Training pictures with ground truth: a settled pile, rendered analytically through a camera of its machine.

Everything except the pile is drawn from the seed of the picture: which logs are already removed, camera, zoom, position
and tilt, light, surfaces, clutter, steel in view, errors of depth.  In some pictures logs and ground have plain
colours, so that the network does not depend on texture.
"""

from __future__ import annotations

import io
import math
import random
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
from PIL import Image, ImageFilter

from machine.geometry.optics import Intrinsics, intrinsics
from sim.camera.geometry import View, look_at
from sim.camera.ground_cover import BARE, CLEARING, LANDING, GroundCover
from sim.camera.render import ImagingConditions, Picture, render
from sim.camera.scene import COVER, GROUND, SKY, Boxes, Ground, LogPose, Rods, Scene, SceneBuilder
from sim.scenes.settled_logs import varied_stereo_noise
from training.pictures.labels import IGNORED, ROW, Labelled, elongation, seen_along
from training.pictures.piles import MACHINES, Pile, ground_of, profile_of, terrain_of
from training.pictures.props import Steel

MAX_LOGS: Final = 16
MIN_LOG_PX: Final = 14
PLAIN_SHARE: Final = 0.35
PLAIN_SKY_SHARE: Final = 0.4  # of the other pictures
HELD_SHARE: Final = 0.12  # of pictures in which a grapple holds a log
AWAY_SHARE: Final = 0.05  # of pictures that show few logs or none
MAX_ZOOM: Final = 4.2  # zoom of the smallest window over the letterboxed picture
MIN_CONTRAST: Final = 45.0  # between logs and ground, in most plain pictures


def draw(pile: Pile, seed: int, size_px: int = 304) -> Labelled:
    """Draw a picture of ``pile`` from ``seed``; deterministic."""
    rng = random.Random(f"frame {pile.machine} {pile.number} {seed}")
    held = rng.random() < HELD_SHARE
    scene, keep = bare_scene(pile, rng, held)
    camera = rng.choice(list(profile_of(pile.machine).cameras))
    view = random_view(pile, keep, camera, rng, size_px, scene.ground)
    boxes = steel_around(pile, keep, view, rng, held)
    scene = replace(scene, boxes=boxes, rods=scene.rods + _clutter(pile, keep, rng))
    conditions = ImagingConditions.random(rng.getrandbits(31))
    picture = render(scene, view, conditions, rng.getrandbits(16))
    if rng.random() < PLAIN_SHARE:
        picture = replace(picture, rgb=_plain(picture, view, conditions, rng))
    elif rng.random() < PLAIN_SKY_SHARE:
        picture = replace(picture, rgb=np.where((picture.mask == SKY)[..., None], _sky(rng), picture.rgb))
    depth = _stereo_depth(pile.machine, camera, picture, view.intrinsics, rng)
    ids, logs = labelled(picture.mask, view, keep)
    return Labelled(_lens_and_compression(picture.rgb, rng), depth, ids, logs, view.intrinsics)


def labelled(mask: np.ndarray, view: View, logs: tuple[LogPose, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Compute ``ids`` and ``logs`` of a sample from the renderer's instances (H, W)."""
    ids = np.zeros(mask.shape, np.uint8)
    rows: list[tuple[float, ...]] = []
    pixels: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    v, u = np.nonzero((mask > 0) & (mask < 1000))
    of = mask[v, u]
    for log in logs:
        own = of == log.instance
        if own.any():
            pixels[log.instance] = u[own], v[own]
    for log in logs:
        if log.instance not in pixels:
            continue
        u, v = pixels[log.instance]
        if len(u) < MIN_LOG_PX or len(rows) == MAX_LOGS:
            ids[v, u] = IGNORED
            continue
        number = len(rows) + 1
        ids[v, u] = number
        rows.append((number, *_row(u, v, view, log, mask.shape)))
    return ids, np.array(rows, np.float32).reshape(-1, ROW)


def _row(u: np.ndarray, v: np.ndarray, view: View, log: LogPose, shape: tuple[int, int]) -> tuple[float, ...]:
    points, radii = log.spine(32)
    ahead = view.to_optical(points)
    front = ahead[:, 2] > 0.2
    pin = view.intrinsics
    spine = np.full((len(points), 2), 1e6)
    spine[front] = pin.project(ahead[front])
    width = 2.0 * radii * pin.fx_px / np.maximum(ahead[:, 2], 0.2)
    # The chord of the part in the picture, because a log may extend far beyond it or behind the camera.
    margin = width
    inside = front & (spine[:, 0] > -margin) & (spine[:, 0] < shape[1] + margin)
    inside &= (spine[:, 1] > -margin) & (spine[:, 1] < shape[0] + margin)
    at = np.flatnonzero(inside)
    first, last = (at[0], at[-1]) if len(at) > 1 else (0, len(points) - 1)
    chord = spine[last] - spine[first]
    if len(at) < 2 or not np.hypot(*chord) > 1e-6:
        cov = np.cov(np.stack([u, v]).astype(float))
        chord = np.linalg.eigh(cov)[1][:, -1]
    length = float(np.hypot(*chord))
    axis = chord / length
    centre, extent = seen_along(u, v, axis)
    seen = []
    for k in (0, -1):
        near = np.hypot(u - spine[k, 0], v - spine[k, 1]).min() if front[k] else math.inf
        in_picture = 0.0 <= spine[k, 0] < shape[1] and 0.0 <= spine[k, 1] < shape[0]
        seen.append(float(in_picture and near < max(2.0, 0.35 * width[k])))
    wide = float(np.median(width[at])) if len(at) else extent
    ends = np.clip(np.concatenate([spine[0], spine[-1]]), -1e5, 1e5)
    return (*centre, *ends, *seen, math.atan2(axis[1], axis[0]) % math.pi, elongation(extent, wide))


def bare_scene(pile: Pile, rng: random.Random, held: bool) -> tuple[Scene, tuple[LogPose, ...]]:
    """Build the pile without the logs already removed from the top; when one is held, the topmost log is in the air."""
    logs = sorted(pile.logs, key=lambda log: log.position_m[2])
    if len(logs) > 1 and rng.random() < 0.4:
        logs = logs[: rng.randint(1, len(logs))]
    if held:
        x, y, z = logs[-1].position_m
        logs[-1] = replace(logs[-1], position_m=(x, y, z + 2.0 * rng.random() ** 2))
    b = SceneBuilder(ground_of(pile), rng.choice(("asphalt", "forest")))
    tint = [rng.uniform(0.75, 1.2) for _ in range(3)]
    for log in logs:
        b.log(log, tuple(c * rng.uniform(0.85, 1.15) for c in tint))
    return b.build(), tuple(logs)


def _pinhole(pile: Pile, camera: str, rng: random.Random, size_px: int) -> Intrinsics:
    """Choose the whole picture letterboxed, or a window with a zoom between 1 and MAX_ZOOM times that of the
    letterbox."""
    pin = intrinsics(profile_of(pile.machine).cameras[camera])
    whole = size_px / max(pin.width_px, pin.height_px)
    if rng.random() < 0.1:
        return pin.letterbox(size_px).outer
    zoomed = pin.scaled(whole * math.exp(rng.uniform(-0.1, math.log(MAX_ZOOM))))
    left = rng.uniform(-0.1, 1.1) * (zoomed.width_px - size_px)
    top = rng.uniform(-0.1, 1.1) * (zoomed.height_px - size_px)
    return zoomed.crop(round(left), round(top), size_px, size_px)


def random_view(
    pile: Pile, logs: tuple[LogPose, ...], camera: str, rng: random.Random, size_px: int, ground: Ground
) -> View:
    """Draw a view of some of the logs from where a machine's cameras can be."""
    pin = _pinhole(pile, camera, rng, size_px)
    mark = rng.choice(logs)
    points, _ = mark.spine(8)
    target = points[rng.randrange(9)] + np.array([rng.gauss(0.0, 0.3), rng.gauss(0.0, 0.3), 0.0])
    if rng.random() < AWAY_SHARE:
        target += np.array([rng.gauss(0.0, 6.0), rng.gauss(0.0, 6.0), 0.0])
    azimuth = rng.uniform(-math.pi, math.pi)
    direction = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    for _ in range(20):
        if camera == "d435" or rng.random() < 0.15:
            elevation, reach = math.radians(rng.uniform(70.0, 89.0)), rng.uniform(2.0, 4.5)
        elif camera == "front" or rng.random() < 0.4:  # height of a camera on a carrier
            height, reach = rng.uniform(1.6, 3.2), 3.0 * 4.0 ** rng.random()
            elevation = math.asin(min(0.99, height / reach))
        else:
            elevation, reach = (
                math.radians(rng.uniform(15.0, 85.0)),
                math.exp(rng.uniform(math.log(2.0), math.log(9.0))),
            )
        eye = target + reach * (math.cos(elevation) * direction + np.array([0.0, 0.0, math.sin(elevation)]))
        if eye[2] > ground.height(eye[0], eye[1]) + 0.7 and _clear_of_logs(eye, logs):
            break
    view = look_at(eye, target, pin)
    # The principal point may be far from the middle of the window: turn the target into the window.
    middle = np.array([(size_px / 2 - pin.cx_px) / pin.fx_px, (size_px / 2 - pin.cy_px) / pin.fy_px, 1.0])
    turn = _rotation_between(middle / np.linalg.norm(middle), np.array([0.0, 0.0, 1.0]))
    roll = rng.gauss(0.0, 0.06) if rng.random() < 0.7 else rng.uniform(-math.pi, math.pi)
    c, s = math.cos(roll), math.sin(roll)
    spin = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return View(pin, view.position_m, view.rotation @ spin @ turn)


def _rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the smallest rotation (3, 3) from unit vector ``a`` to ``b``."""
    w, c = np.cross(a, b), float(a @ b)
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    return np.asarray(np.eye(3) + k + k @ k / (1.0 + c))


def _clear_of_logs(eye: np.ndarray, logs: tuple[LogPose, ...]) -> bool:
    return all(np.linalg.norm(log.spine(12)[0] - eye, axis=1).min() > 1.2 for log in logs)


def steel_around(pile: Pile, logs: tuple[LogPose, ...], view: View, rng: random.Random, held: bool) -> Boxes:
    steel, profile = Steel(rng), profile_of(rng.choice(MACHINES))
    mark = np.asarray(rng.choice(logs).position_m)
    if pile.kind == "bunk":
        steel.bunk(profile_of(pile.machine), np.zeros(3), 0.0)
    if held:
        steel.holding(profile, logs[-1])
    elif rng.random() < 0.3:
        above = mark + np.array([rng.gauss(0.0, 0.6), rng.gauss(0.0, 0.6), rng.uniform(0.7, 2.2)])
        steel.grapple(profile, above, rng.uniform(-math.pi, math.pi), rng.random())
    if rng.random() < 0.2:
        share = rng.uniform(0.3, 0.8)
        steel.boom(view.position_m + share * (mark - view.position_m) + [rng.gauss(0.0, 0.5) for _ in range(3)])
    for _ in range(rng.choice((0, 0, 0, 1, 2))):
        away, turn = rng.uniform(2.2, 6.0), rng.uniform(-math.pi, math.pi)
        spot = mark + np.array([away * math.cos(turn), away * math.sin(turn), 0.0])
        spot[2] = ground_of(pile).height(spot[0], spot[1])
        # A crate must not intersect a log.
        if all(np.linalg.norm(log.spine(6)[0] - spot, axis=1).min() > 1.4 for log in logs):
            steel.block(spot)
    return steel.build()


@lru_cache(maxsize=48)
def _ground_cover(ground: tuple[str, int, float], kind: int, seed: int) -> GroundCover:
    return GroundCover(Ground(*terrain_of(*ground).grid), (BARE, LANDING, CLEARING)[kind], seed)


def _clutter(pile: Pile, logs: tuple[LogPose, ...], rng: random.Random) -> Rods:
    """Strew grass and branches; with few seeds, so that tiles are generated once and reused."""
    kind = rng.choices((0, 1, 2), (0.3, 0.3, 0.4))[0]
    x, y, _ = rng.choice(logs).position_m
    seed = rng.randrange(3) if kind else 0
    return _ground_cover((pile.terrain, pile.terrain_seed, pile.datum_m), kind, seed).around(x, y, 5.0)


def _stereo_depth(machine: str, camera: str, picture: Picture, pin: Intrinsics, rng: random.Random) -> np.ndarray:
    """Compute stereo depth, better or worse than nominal; sometimes nearly perfect or full of holes."""
    sigma = math.exp(rng.uniform(math.log(0.25), math.log(1.6)))
    edges = (rng.uniform(0.3, 1.1), rng.uniform(0.3, 1.1))
    holes, plain_holes = math.exp(rng.uniform(-1.0, 2.0)), rng.uniform(0.01, 0.25)
    reach = float(rng.choice((6, 10, 14)))
    noise = varied_stereo_noise(
        profile_of(machine),
        camera,
        rng.getrandbits(20),
        sigma=sigma,
        edges=edges,
        holes=holes,
        plain_holes=plain_holes,
        correlation_px=reach,
    )
    return noise.apply(picture, pin, 0)


def _plain(picture: Picture, view: View, conditions: ImagingConditions, rng: random.Random) -> np.ndarray:
    """Paint ground, logs and sky of the picture in one colour each, lit by the sun; leave the rest unchanged."""
    pin, s = view.intrinsics, np.nan_to_num(1.0 / picture.depth_m, nan=0.0)
    h, w = s.shape
    u = ((np.arange(w) - pin.cx_px) / pin.fx_px).astype(np.float32)
    v = ((np.arange(h)[:, None] - pin.cy_px) / pin.fy_px).astype(np.float32)
    # Inverse depth of a plane is linear in the picture, and its coefficients are the normal.
    normal = np.zeros((3, h, w), np.float32)
    normal[0, :, :-1] = (s[:, :-1] - s[:, 1:]) * pin.fx_px
    normal[1, :-1] = (s[:-1] - s[1:]) * pin.fy_px
    normal[2] = -s - u * normal[0] - v * normal[1]
    normal /= np.sqrt((normal * normal).sum(axis=0)) + 1e-9
    sun = view.rotation.T @ np.asarray(conditions.sun)
    ambient = rng.uniform(0.35, 0.75)
    light = ambient + (1.0 - ambient) * np.clip(np.tensordot(sun.astype(np.float32), normal, 1), 0.0, 1.0)
    bark, earth, keep = _colour(rng), _colour(rng), rng.choice((0.0, 0.0, 0.3, 0.6))  # keep: share of the texture
    if rng.random() < 0.8:
        while np.linalg.norm(bark - earth) < MIN_CONTRAST:
            bark, earth = _colour(rng), _colour(rng)
    paint, painted = np.zeros((COVER + 2, 3), np.float32), np.zeros(COVER + 2, np.float32)
    for instance in range(1, MAX_LOGS + 1):
        paint[instance], painted[instance] = bark * rng.uniform(0.9, 1.1), 1.0 - keep
    paint[GROUND], painted[GROUND] = earth, 1.0 - keep
    paint[COVER], painted[COVER] = _colour(rng), rng.choice((0.0, 1.0))
    cover = painted[picture.mask][..., None]
    rgb = np.clip(picture.rgb + cover * (paint[picture.mask] * light[..., None] - picture.rgb), 0.0, 255.0)
    return np.where((picture.mask == SKY)[..., None], _sky(rng), rgb.astype(np.uint8))


def _sky(rng: random.Random) -> np.ndarray:
    """Choose one colour (3,) uint8: white, bright or random."""
    kind = rng.random()
    if kind < 0.4:
        return np.full(3, 255, np.uint8)
    least = 150 if kind < 0.8 else 0
    return np.array([rng.randint(least, 255) for _ in range(3)], np.uint8)


def _colour(rng: random.Random) -> np.ndarray:
    """Choose a colour: mostly that of earth or wood, sometimes random."""
    if rng.random() < 0.25:
        return np.array([rng.uniform(20.0, 250.0) for _ in range(3)], np.float32)
    grey, warm = rng.uniform(60.0, 210.0), rng.uniform(0.0, 0.5)
    return np.array([grey * (1.0 + 0.5 * warm), grey, grey * (1.0 - warm)], np.float32)


def _lens_and_compression(rgb: np.ndarray, rng: random.Random) -> np.ndarray:
    """Apply blur and compression of a real camera, each in half of the pictures."""
    picture = Image.fromarray(rgb)
    if rng.random() < 0.5:
        picture = picture.filter(ImageFilter.GaussianBlur(rng.uniform(0.3, 1.4)))
    if rng.random() < 0.5:
        file = io.BytesIO()
        picture.save(file, "JPEG", quality=rng.randint(30, 90))
        picture = Image.open(file)
    return np.asarray(picture, np.uint8)
