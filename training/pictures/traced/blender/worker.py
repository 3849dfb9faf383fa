"""Draws scenes: ``python -m training.pictures.traced.blender.worker FOLDER THREADS NUMBER COUNT``.

Reads FOLDER/scenes/*.json, of which it takes every COUNTth from NUMBER, and writes FOLDER/pictures/NAME-VIEW.npz, each
whole or not at all; what is there is not drawn again.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np

from training.pictures.traced.blender import camera
from training.pictures.traced.blender.matching import matched_depth
from training.pictures.traced.blender.materials import bark, end_grain, ground, leafy, plain
from training.pictures.traced.shapes import Shape
from training.pictures.traced.staging import Piece, pieces


def main(folder: Path, threads: int, number: int, count: int) -> None:
    """Draw what is missing."""
    target = folder / "pictures"
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for file in sorted((folder / "scenes").glob("*.json"))[number::count]:
            scene = json.loads(file.read_text())
            missing = [k for k in range(len(scene["views"])) if not (target / f"{file.stem}-{k}.npz").is_file()]
            if not missing:
                continue
            began = time.monotonic()
            build(scene)
            print(f"{file.stem}: built in {time.monotonic() - began:.1f} s", flush=True)
            camera.prepare(threads)
            for k in missing:
                began = time.monotonic()
                camera.keep(target / f"{file.stem}-{k}.npz", draw(scene["views"][k], Path(scratch)))
                print(f"{file.stem}-{k}: {time.monotonic() - began:.1f} s", flush=True)


def draw(view: Mapping[str, Any], scratch: Path) -> dict[str, np.ndarray]:
    """Draw the arrays of one picture: light float16 (linear), depth_m, ids, and matched_m with a second eye."""
    camera.light(view["light"])
    camera.aim(view)
    light = camera.shoot(scratch, view["samples"], view["seed"])
    depth, ids = camera.measure(scratch)
    arrays = {"light": np.clip(light, 0.0, 6e4).astype(np.float16), "depth_m": depth.astype(np.float32), "ids": ids}
    if view["baseline_m"]:
        camera.aim(view, view["baseline_m"])
        other = camera.shoot(scratch, view["samples"], view["seed"] + 1)
        arrays["matched_m"] = matched_depth(light, other, view["focal_px"], view["baseline_m"], view["seed"])
    return arrays


# -- A scene in Blender from its placed shapes.


def build(scene: Mapping[str, Any]) -> None:
    """Build everything but camera and light, in an empty file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    materials: dict[str, Any] = {}
    meshes: dict[int, Any] = {}
    live_shapes: list[Shape] = []  # so that no other shape gets the identity of one that is gone
    for piece in pieces(scene):
        if id(piece.shape) not in meshes:
            live_shapes.append(piece.shape)
            meshes[id(piece.shape)] = _mesh(piece, materials)
        _place(piece, meshes[id(piece.shape)])


def _mesh(piece: Piece, materials: dict[str, Any]) -> Any:
    shape = piece.shape
    mesh = bpy.data.meshes.new("shape")
    mesh.from_pydata(shape.vertices.tolist(), [], [[i for i in f if i >= 0] for f in shape.faces.tolist()])
    for look in piece.looks:
        name = repr(sorted((k, v) for k, v in look.items() if v is not None))
        if name not in materials:
            materials[name] = _material(look)
        mesh.materials.append(materials[name])
    mesh.polygons.foreach_set("use_smooth", shape.smooth.tolist())
    mesh.polygons.foreach_set("material_index", np.minimum(shape.slot, len(piece.looks) - 1).tolist())
    if shape.uv is not None:
        index = np.empty(len(mesh.loops), np.int32)
        mesh.loops.foreach_get("vertex_index", index)
        mesh.uv_layers.new(name="around").data.foreach_set("uv", shape.uv[index].astype(np.float32).ravel())
    return mesh


def _place(piece: Piece, mesh: Any) -> None:
    thing = bpy.data.objects.new("piece", mesh)
    turn = mathutils.Matrix((piece.scale * piece.turn).tolist()).to_4x4()
    thing.matrix_world = mathutils.Matrix.Translation(piece.position_m) @ turn
    thing.pass_index = piece.number
    if piece.bevelled:
        edges = thing.modifiers.new("edges", "BEVEL")
        edges.width, edges.segments = 0.008, 2
    bpy.context.scene.collection.objects.link(thing)


def _material(look: Mapping[str, Any]) -> Any:
    surface_type = look["what"]
    if surface_type == "ground":
        return ground(look)
    if surface_type == "bark":
        return bark(look)
    if surface_type == "end":
        return end_grain(look)
    if surface_type == "leaf":
        return leafy(look["tones"])
    return plain(look["tones"], 5.0 * look["scale"], look.get("rough", 0.9), look["relief"], look.get("metal", 0.0))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
