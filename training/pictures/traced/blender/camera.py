"""Camera, light and pictures: colour, optical depth and numbers of the logs as arrays."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np

FAR_M = 1000.0  # beyond is sky
SKIES = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "studiolights" / "world"


def prepare(threads: int) -> None:
    """Apply the settings that all pictures share, and add the camera and the sun as objects."""
    sc = bpy.context.scene
    sc.render.engine, sc.cycles.device = "CYCLES", "CPU"
    sc.cycles.max_bounces, sc.cycles.diffuse_bounces, sc.cycles.glossy_bounces = 3, 2, 1
    sc.cycles.transmission_bounces, sc.cycles.transparent_max_bounces = 2, 2
    sc.cycles.caustics_reflective = sc.cycles.caustics_refractive = False
    sc.cycles.use_adaptive_sampling = False
    sc.cycles.denoiser, sc.cycles.denoising_prefilter = "OPENIMAGEDENOISE", "FAST"
    sc.render.resolution_percentage = 100
    sc.render.threads_mode, sc.render.threads = "FIXED", threads
    sc.render.use_persistent_data = True
    sc.render.use_sequencer = False
    sc.view_layers[0].use_pass_z = sc.view_layers[0].use_pass_object_index = True
    lens = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    lamp = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    for thing in (lens, lamp):
        sc.collection.objects.link(thing)
    sc.camera = lens


def aim(view: Mapping[str, Any], shift_m: float = 0.0) -> None:
    """Place the camera at a view, moved ``shift_m`` to its right (the second eye)."""
    size = view["width_px"], view["height_px"]
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = size
    lens = bpy.data.objects["camera"]
    turn = np.array(view["turn"])
    eye = np.array(view["eye_m"]) + shift_m * turn[:, 0]
    gl = turn * (1.0, -1.0, -1.0)
    lens.matrix_world = mathutils.Matrix.Translation(eye) @ mathutils.Matrix(gl.tolist()).to_4x4()
    data = lens.data
    data.sensor_fit, data.sensor_width = "HORIZONTAL", 36.0
    data.lens = view["focal_px"] / size[0] * 36.0
    data.shift_x = (0.5 * (size[0] - 1) - view["cx_px"]) / size[0]
    data.shift_y = (view["cy_px"] - 0.5 * (size[1] - 1)) / size[0]
    data.clip_start, data.clip_end = 0.05, 500.0


def light(look: Mapping[str, Any]) -> None:
    """Set up sky, sun and lamps."""
    world = bpy.data.worlds.get("sky") or bpy.data.worlds.new("sky")
    bpy.context.scene.world = world
    world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    out, back = tree.nodes.new("ShaderNodeOutputWorld"), tree.nodes.new("ShaderNodeBackground")
    tree.links.new(back.outputs[0], out.inputs[0])
    back.inputs["Strength"].default_value = look["sky_strength"]
    kind = look["sky"]
    if kind == "nishita":
        sky = tree.nodes.new("ShaderNodeTexSky")
        sky.sky_type, sky.sun_disc = "NISHITA", False
        sky.sun_elevation, sky.sun_rotation = look["elevation_rad"], -look["azimuth_rad"] + 0.5 * math.pi
        sky.dust_density, sky.air_density = look["dust"], 1.0
        tree.links.new(sky.outputs[0], back.inputs[0])
    elif kind == "flat":
        back.inputs["Color"].default_value = (*look["tone"], 1.0)
    else:
        picture = tree.nodes.new("ShaderNodeTexEnvironment")
        picture.image = bpy.data.images.load(str(SKIES / f"{kind}.exr"), check_existing=True)
        spun = tree.nodes.new("ShaderNodeMapping")
        spun.inputs["Rotation"].default_value = (0.0, 0.0, look["azimuth_rad"])
        texture_coordinates = tree.nodes.new("ShaderNodeTexCoord")
        tree.links.new(texture_coordinates.outputs["Generated"], spun.inputs[0])
        tree.links.new(spun.outputs[0], picture.inputs[0])
        tree.links.new(picture.outputs[0], back.inputs[0])
    lamp = bpy.data.objects["sun"]
    lamp.data.energy, lamp.data.angle = look["sun_strength"], look["sun_angle_rad"]
    lamp.data.color = look["sun_tone"]
    elevation_rad, direction = look["elevation_rad"], look["azimuth_rad"]
    ray = mathutils.Vector(
        (
            math.cos(elevation_rad) * math.cos(direction),
            math.cos(elevation_rad) * math.sin(direction),
            math.sin(elevation_rad),
        )
    )
    lamp.rotation_euler = ray.to_track_quat("Z", "Y").to_euler()
    for old in [o for o in bpy.data.objects if o.name.startswith("work light")]:
        bpy.data.objects.remove(old)
    for k, lit in enumerate(look["lamps"]):
        spot = bpy.data.objects.new(f"work light {k}", bpy.data.lights.new("work light", "SPOT"))
        spot.data.energy, spot.data.spot_size, spot.data.color = lit["watts"], 1.6, lit["tone"]
        spot.data.shadow_soft_size = 0.06
        spot.location = lit["at_m"]
        direction = mathutils.Vector(lit["at_m"]) - mathutils.Vector(lit["target_m"])
        spot.rotation_euler = direction.to_track_quat("Z", "Y").to_euler()
        bpy.context.scene.collection.objects.link(spot)


def shoot(folder: Path, samples: int, seed: int) -> np.ndarray:
    """Render linear colour (H, W, 3) float32, with noise removed."""
    sc = bpy.context.scene
    sc.cycles.samples, sc.cycles.seed, sc.cycles.use_denoising = samples, seed, True
    sc.cycles.pixel_filter_type, sc.cycles.filter_width = "BLACKMAN_HARRIS", 1.5
    return _rendered(folder, ("Image",))["Image"][..., :3]


def measure(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Render optical depth (H, W) float32 [m], NaN for the sky, and number (H, W) uint8 of the log at each pixel's
    middle."""
    sc = bpy.context.scene
    sc.cycles.samples, sc.cycles.use_denoising = 1, False
    sc.cycles.pixel_filter_type, sc.cycles.filter_width = "BOX", 0.01
    before = sc.cycles.max_bounces
    sc.cycles.max_bounces = 0
    passes = _rendered(folder, ("Depth", "IndexOB"))
    sc.cycles.max_bounces = before
    depth = passes["Depth"][..., 0]
    return np.where(depth < FAR_M, depth, np.nan), np.round(passes["IndexOB"][..., 0]).astype(np.uint8)


def _rendered(folder: Path, wanted: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Render passes (H, W, 4) float32 by name, first row at the top."""
    sc = bpy.context.scene
    sc.use_nodes, sc.render.use_compositing = True, True
    tree = sc.node_tree
    tree.nodes.clear()
    layers = tree.nodes.new("CompositorNodeRLayers")
    for name in wanted:
        file = tree.nodes.new("CompositorNodeOutputFile")
        file.base_path, file.file_slots[0].path = str(folder), f"{name}_"
        file.format.file_format, file.format.color_depth = "OPEN_EXR", "32"
        file.format.exr_codec = "NONE"
        tree.links.new(layers.outputs[name], file.inputs[0])
    whole = tree.nodes.new("CompositorNodeComposite")
    tree.links.new(layers.outputs["Image"], whole.inputs[0])
    sc.frame_set(1)
    bpy.ops.render.render()
    passes = {}
    for name in wanted:
        image = bpy.data.images.load(str(folder / f"{name}_0001.exr"))
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        values = np.empty(width * height * 4, np.float32)
        image.pixels.foreach_get(values)
        passes[name] = values.reshape(height, width, 4)[::-1]
        bpy.data.images.remove(image)
    return passes


def keep(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write the arrays of a picture, whole or not at all."""
    draft = file.with_suffix(f".{os.getpid()}.part")
    with draft.open("wb") as out:
        np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    draft.replace(file)
