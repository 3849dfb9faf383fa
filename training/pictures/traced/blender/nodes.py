"""Short ways to build Blender's shader graphs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy

Colour = Sequence[float]
MAX_DETAIL = 4.5  # octaves of noise: finer ones cost time and are smaller than a pixel


class Graph:
    """One material's node tree; sockets are passed around as values."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.surface = self.tree.nodes["Principled BSDF"]
        self.set("Roughness", 0.9)
        self.set("Specular IOR Level", 0.25)

    def node(self, kind: str, **settings: Any) -> Any:
        """Add a new node with attributes set."""
        made = self.tree.nodes.new(f"ShaderNode{kind}")
        for name, value in settings.items():
            setattr(made, name, value)
        return made

    def link(self, value: Any, socket: Any) -> None:
        """Connect a socket, or set a constant."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif isinstance(value, (tuple, list)) and len(value) == 3 and socket.type == "RGBA":
            socket.default_value = (*value, 1.0)
        else:
            socket.default_value = value

    def set(self, name: str, value: Any) -> None:
        """Set an input of the surface."""
        self.link(value, self.surface.inputs[name])

    def coordinates(self, kind: str = "Object", scale: Sequence[float] = (1, 1, 1), shift: float = 0.0) -> Any:
        """Return object, generated or world coordinates, scaled and shifted."""
        out = self.node("NewGeometry").outputs["Position"] if kind == "World" else (self.node("TexCoord").outputs[kind])
        moved = self.node("Mapping")
        self.link(out, moved.inputs["Vector"])
        moved.inputs["Scale"].default_value = tuple(scale)
        moved.inputs["Location"].default_value = (shift, 1.7 * shift, 0.6 * shift)
        return moved.outputs["Vector"]

    def noise(self, at: Any, scale: float, detail: float = 6.0, rough: float = 0.6, warp: float = 0.0) -> Any:
        """Add fractal noise, about 0.3 to 0.7."""
        made = self.node("TexNoise")
        self.link(at, made.inputs["Vector"])
        for name, value in (
            ("Scale", scale),
            ("Detail", min(detail, MAX_DETAIL)),
            ("Roughness", rough),
            ("Distortion", warp),
        ):
            made.inputs[name].default_value = value
        return made.outputs["Fac"]

    def cells(self, at: Any, scale: float, feature: str = "F1", out: str = "Distance") -> Any:
        """Add Voronoi cells: the distance to a cell's point or edge."""
        made = self.node("TexVoronoi", feature=feature)
        self.link(at, made.inputs["Vector"])
        made.inputs["Scale"].default_value = scale
        return made.outputs[out]

    def ramp(self, value: Any, colours: Sequence[Colour], low: float = 0.35, high: float = 0.65) -> Any:
        """Spread colours over a value."""
        made = self.node("ValToRGB")
        stops = made.color_ramp.elements
        stops[0].position, stops[1].position = low, high
        stops[0].color, stops[1].color = (*colours[0], 1.0), (*colours[-1], 1.0)
        for i, colour in enumerate(colours[1:-1], 1):
            stops.new(low + (high - low) * i / (len(colours) - 1)).color = (*colour, 1.0)
        self.link(value, made.inputs["Fac"])
        return made.outputs["Color"]

    def step(self, value: Any, low: float, high: float) -> Any:
        """Return 0 below ``low``, 1 above ``high``, smooth between; swapped bounds turn it round."""
        made = self.node("MapRange", interpolation_type="SMOOTHSTEP")
        turned = low > high
        self.link(value, made.inputs["Value"])
        made.inputs["From Min"].default_value, made.inputs["From Max"].default_value = min(low, high), max(low, high)
        made.inputs["To Min"].default_value, made.inputs["To Max"].default_value = (1, 0) if turned else (0, 1)
        return made.outputs["Result"]

    def math(self, kind: str, a: Any, b: Any = 0.0) -> Any:
        """Add a scalar operation."""
        made = self.node("Math", operation=kind)
        self.link(a, made.inputs[0])
        self.link(b, made.inputs[1])
        return made.outputs[0]

    def mix(self, share: Any, a: Any, b: Any, how: str = "MIX") -> Any:
        """Mix colours ``a`` and ``b``."""
        made = self.node("MixRGB", blend_type=how)
        self.link(share, made.inputs["Fac"])
        self.link(a, made.inputs["Color1"])
        self.link(b, made.inputs["Color2"])
        return made.outputs["Color"]

    def bump(self, height: Any, strength: float, distance_m: float, before: Any = None) -> Any:
        """Bend a normal by a height; set it on the surface and return it."""
        made = self.node("Bump")
        made.inputs["Strength"].default_value, made.inputs["Distance"].default_value = strength, distance_m
        self.link(height, made.inputs["Height"])
        if before is not None:
            self.link(before, made.inputs["Normal"])
        self.link(made.outputs["Normal"], self.surface.inputs["Normal"])
        return made.outputs["Normal"]

    def upward(self) -> Any:
        """Return the vertical part of the true normal, -1 to 1."""
        made = self.node("SeparateXYZ")
        self.link(self.node("NewGeometry").outputs["Normal"], made.inputs[0])
        return made.outputs["Z"]
