"""The cameras of a machine: their true poses, the frames they deliver, and their nominal mounts.

An ``RgbdFrame`` carries both poses: the nominal mount, the only one that autonomy may use, and the true one, for
evaluation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from machine.geometry.optics import Intrinsics, intrinsics
from machine.profile import Profile
from sim.camera.geometry import View, mount_view
from sim.camera.ground_cover import CLEARING, LANDING, Density, GroundCover
from sim.camera.noise import StereoNoise
from sim.camera.render import ImagingConditions, Picture, render
from sim.camera.scene import Scene, WorldScenes
from sim.geometry import Vector
from sim.truth.load import Truth
from sim.world import World


@dataclass(frozen=True, slots=True)
class Mount:
    """The mount in the profile: a link, and the body frame (x forward, y left, z up) in it."""

    link: str
    position_m: Vector
    rpy_rad: Vector


@dataclass(frozen=True, slots=True)
class RgbdFrame:
    """One delivered frame.

    rgb (H, W, 3) uint8; depth_m (H, W) float32, optical z, NaN: unknown (a hole, too near, too far, sky, letterbox
    bar); ``stamp_ns`` of its capture; ``true_position_m`` (3,) and ``true_rotation`` (3, 3) of the optical frame in the
    world are for evaluation only.
    """

    name: str
    stamp_ns: int
    rgb: np.ndarray
    depth_m: np.ndarray
    intrinsics: Intrinsics
    mount: Mount
    true_position_m: np.ndarray
    true_rotation: np.ndarray


class CameraRig:
    """All cameras of ``profile``, with the mounts and errors of ``truth``.

    ``seed`` draws the imaging conditions, the ground cover and every frame's noise.  ``source`` is a World or a
    function that returns the present Scene.  ``size_px`` letterboxes frames into a square (paper B: 608), None keeps
    the camera's own size.  ``density`` is that of the ground cover (of a World only).
    """

    def __init__(
        self,
        source: World | Callable[[], Scene],
        profile: Profile,
        truth: Truth,
        seed: int,
        size_px: int | None = 608,
        density: Density | None = None,
    ) -> None:
        self.conditions = ImagingConditions.random(seed)
        self._profile, self._truth, self._size_px = profile, truth, size_px
        self._scenes = WorldScenes(source) if isinstance(source, World) else source
        self._cover: GroundCover | None = None
        if isinstance(self._scenes, WorldScenes):
            litter = density or (LANDING if self._scenes.style == "asphalt" else CLEARING)
            self._cover = GroundCover(self._scenes.ground, litter, seed)
        self._noise = {
            name: StereoNoise(camera, truth.cameras[name], f"{name} {seed}") for name, camera in profile.cameras.items()
        }
        self._counts = dict.fromkeys(profile.cameras, 0)
        self.names = tuple(profile.cameras)

    def view(self, name: str, scene: Scene) -> View:
        """Return the true view of a camera, with its own pinhole."""
        camera, truth = self._profile.cameras[name], self._truth.cameras[name]
        pose, error = scene.links[camera.link], (truth.mount_position_m, truth.mount_rpy_rad)
        return mount_view(pose, intrinsics(camera), camera.position_m, camera.rpy_rad, *error)

    def scene(self, name: str) -> Scene:
        """Return the present scene, with the ground cover near a camera."""
        scene = self._scenes()
        if self._cover is not None:
            x, y, _ = scene.links[self._profile.cameras[name].link][0]
            scene = replace(scene, rods=scene.rods + self._cover.around(x, y))
        return scene

    def picture(self, name: str) -> tuple[Scene, View, Picture]:
        """Return scene, view and picture of an ideal camera at the true pose, for labels: without bars or noise."""
        scene = self.scene(name)
        return scene, *self._picture(name, scene)

    def frame(self, name: str, now_ns: int) -> RgbdFrame:
        """Take the next frame of camera ``name``.

        Raises:
            KeyError: the profile has no such camera.
        """
        return self.capture(name, self.scene(name), now_ns)

    def capture(self, name: str, scene: Scene, now_ns: int) -> RgbdFrame:
        """Take the next frame of camera ``name``, of a scene that was visible at ``now_ns``."""
        camera = self._profile.cameras[name]
        view, picture = self._picture(name, scene)
        rgb, pin = picture.rgb, view.intrinsics
        depth = self._noise[name].apply(picture, pin, self._counts[name], view)
        self._counts[name] += 1
        if self._size_px is not None:
            box = intrinsics(camera).letterbox(self._size_px)
            depth, rgb, pin = box.pad(depth, np.nan), box.pad(rgb, 0), box.outer
        mount = Mount(camera.link, camera.position_m, camera.rpy_rad)
        return RgbdFrame(name, now_ns, rgb, depth, pin, mount, view.position_m, view.rotation)

    def _picture(self, name: str, scene: Scene) -> tuple[View, Picture]:
        view = self.view(name, scene)
        if self._size_px is not None:
            view = View(view.intrinsics.letterbox(self._size_px).inner, view.position_m, view.rotation)
        return view, render(scene, view, self.conditions, self._counts[name])
