"""Plots: the chain from pile to grasp as in Fig. 5 of paper A, and its Table II as bars."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from autonomy.grasp.cnn_planner import CnnPlanner
from autonomy.grasp.cylinders import as_cylinders
from autonomy.grasp.network import GraspNet
from autonomy.grasp.planner import GraspRequest
from autonomy.grasp.quality import Jaws, jaws_of
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.grasp.virtual_scene import Camera
from autonomy.motion.arm_kinematics import Arm
from experiments.common.worlds import profile_named
from experiments.grasp_configs.pose_sources import true_poses
from experiments.grasp_configs.trial import arranged
from machine.geometry.optics import pinhole
from runtime.plot_style import MOSS, OIL, RUST, STEEL, TIMBER, sheet
from sim.camera.geometry import orbit
from sim.camera.render import ImagingConditions, render
from sim.camera.scene import scene_from_world
from sim.plant import Plant

SHOWN_CONFIGURATION: Final = 9  # that of Fig. 5 of the paper
COLOURS: Final = {"optimal": MOSS, "NI": TIMBER, "SE": OIL, "MA": STEEL, "failed": RUST}


def draw_chain(path: Path, name: str, truth: str, seed: int) -> None:
    """Draw the pile, the virtual depth with the grasp of the search, and the quality map with that of the network."""
    profile = profile_named(name)
    plant = Plant(profile, seed, truth, scene=arranged(name, truth, SHOWN_CONFIGURATION, seed)[0])
    try:
        logs = true_poses(plant)
        x, y, z = (float(v) for v in np.mean([log.center_m for log in logs], axis=0))
        view = orbit((x, y, z), 4.5, math.radians(-60.0), math.radians(35.0), pinhole(480, 480, 0.75))
        picture = render(scene_from_world(plant.world), view, ImagingConditions()).rgb
    finally:
        plant.close()
    jaws, net = jaws_of(profile), GraspNet()
    virtual_view = CnnPlanner(net).view(as_cylinders(logs), jaws, profile.workspace.ground_z_m)
    quality = net.maps(virtual_view.depth_m).q
    chosen = SamplingPlanner()(GraspRequest(Arm(profile), logs, 0.0))
    with sheet(path, 3, 10.0, 3.6) as (scene, depth, q):
        scene.imshow(picture)
        scene.set(title="the pile")
        depth.imshow(virtual_view.depth_m, cmap="gray_r")
        depth.set(title="virtual depth; the search's grasp")
        grasp_point_m = np.array([[chosen.x_m, chosen.y_m, chosen.support_z_m]])
        _mark(
            depth,
            _pixel(virtual_view.camera, grasp_point_m),
            -chosen.yaw_rad,
            _opening_px(jaws, virtual_view.camera, grasp_point_m),
            MOSS,
        )
        q.imshow(quality, cmap="viridis")
        q.set(title=f"network's quality, best {virtual_view.best.q:.2f}")
        deep = np.array([[0.0, 0.0, float(virtual_view.camera.position_m[2]) - 3.0]])
        _mark(
            q,
            (virtual_view.best.u_px, virtual_view.best.v_px),
            virtual_view.best.theta_rad,
            _opening_px(jaws, virtual_view.camera, deep),
            RUST,
        )
        for axis in (scene, depth, q):
            axis.set(xticks=[], yticks=[])
            axis.grid(False)


def _pixel(camera: Camera, point_m: np.ndarray) -> tuple[float, float]:
    u, v = camera.intrinsics.project((point_m - camera.position_m) * (1.0, -1.0, -1.0))[0]
    return float(u), float(v)


def _opening_px(jaws: Jaws, camera: Camera, point_m: np.ndarray) -> float:
    return 2.0 * jaws.half_gap_m * camera.intrinsics.fx_px / float(camera.position_m[2] - point_m[0, 2])


def _mark(axis: Any, at: tuple[float, float], theta: float, opening_px: float, colour: str) -> None:
    """Draw a grasp: its middle, the opening, and the jaws at both ends."""
    u, v = at
    c, s, half = math.cos(theta), math.sin(theta), opening_px / 2
    axis.plot([u - half * c, u + half * c], [v - half * s, v + half * s], color=colour, lw=1.2, ls=":")
    for side in (-half, half):
        eu, ev, w = u + side * c, v + side * s, 0.25 * half
        axis.plot([eu + w * s, eu - w * s], [ev - w * c, ev + w * c], color=colour, lw=2.5)
    axis.plot([u], [v], "o", ms=5, color=colour, mec="white")


def draw_table(path: Path, outcomes: Mapping[str, dict[str, Any]], pair: str) -> None:
    """Draw outcomes and logs per grasp of every configuration."""
    trials = [o for name, o in outcomes.items() if name.startswith(f"{pair}/")]
    numbers = sorted({o["configuration"] for o in trials})
    with sheet(path, 2, 9.0, 3.2) as (shares, logs):
        base = np.zeros(len(numbers))
        for category, colour in COLOURS.items():
            part = np.array([_share(trials, n, category) for n in numbers])
            shares.bar(range(len(numbers)), part, 0.7, base, color=colour, label=category)
            base += part
        shares.set(title="outcomes [%]", xlabel="configuration", ylim=(0, 100))
        shares.legend(ncols=5, loc="upper center", bbox_to_anchor=(0.5, -0.18), fontsize=7, handlelength=1.0)
        for offset, key, colour, label in ((-0.2, "logs", STEEL, "there"), (0.2, "lifted", MOSS, "lifted")):
            means = [np.mean([o[key] for o in trials if o["configuration"] == n]) for n in numbers]
            logs.bar(np.arange(len(numbers)) + offset, means, 0.38, color=colour, label=label)
        logs.set(title="logs, and logs per grasp", xlabel="configuration")
        logs.legend()
        for axis in (shares, logs):
            axis.set_xticks(range(len(numbers)), [str(n) for n in numbers])


def _share(trials: list[dict[str, Any]], number: int, category: str) -> float:
    its = [o["category"] for o in trials if o["configuration"] == number]
    return 100.0 * its.count(category) / len(its) if its else 0.0
