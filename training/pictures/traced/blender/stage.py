"""A scene in Blender from its placed shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
import mathutils
import numpy as np

from training.pictures.traced.blender.barks import bark, end_grain
from training.pictures.traced.blender.grounds import ground, leafy, plain
from training.pictures.traced.shapes import Shape
from training.pictures.traced.staging import Piece, pieces


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
