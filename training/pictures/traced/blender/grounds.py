"""Materials of the ground and of what grows and lies on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from training.pictures.traced.blender.barks import SNOW
from training.pictures.traced.blender.nodes import Graph


def ground(look: Mapping[str, Any]) -> Any:
    """Make the ground: two kinds of soil mixed by patches, small clods, perhaps snow and puddles."""
    g = Graph("ground")
    s = look["seed"]
    at = g.coordinates("World", (1, 1, 1), s)
    first, height = _soil(g, look["first"], s)
    second, other = _soil(g, look["second"], s + 4)
    patch = g.step(g.noise(at, look["patch_scale"], 7, 0.65), 0.45, 0.57)
    colour, height = g.mix(patch, first, second), g.mix(patch, height, other)
    wide = g.ramp(g.noise(at, 0.5, 4), [(0.55, 0.53, 0.5), (1, 1, 1)], 0.3, 0.65)
    colour = g.mix(0.7, colour, wide, "MULTIPLY")
    normal = g.bump(height, look["relief"], 0.03)
    rough: Any = 0.97 - 0.35 * look["wet"]
    if look["snow"]:
        cover = g.noise(g.coordinates("World", (1, 1, 1), s + 8), look["snow_scale"], 8, 0.6)
        share = g.step(cover, 0.72 - 0.5 * look["snow"], 0.75 - 0.48 * look["snow"])
        crust = g.noise(g.coordinates("World"), 30.0, 5)
        colour = g.mix(share, colour, g.mix(g.math("MULTIPLY", crust, 0.25), SNOW, (0.55, 0.58, 0.65)))
        g.bump(g.math("ADD", g.math("MULTIPLY", share, 0.7), g.math("MULTIPLY", crust, 0.3)), 0.7, 0.04, normal)
    if look["puddles"]:
        water = g.step(g.noise(at, 0.9, 3), 0.6, 0.63)
        colour = g.mix(g.math("MULTIPLY", water, 0.8), colour, (0.02, 0.018, 0.014))
        rough = g.math("SUBTRACT", rough, g.math("MULTIPLY", water, 0.6))
    g.set("Base Color", colour)
    g.set("Roughness", rough)
    return g.material


def _soil(g: Graph, look: Mapping[str, Any], s: float) -> tuple[Any, Any]:
    """Make colour and height of one kind of soil: photographed, or of noise in two sizes, cells, or needles."""
    tones: Sequence[Any] = look["tones"]
    if look["kind"] == "photo":
        at = g.coordinates("World", (look["scale"],) * 3, s)
        colour = g.image(look["image"], at)
        grey = g.node("RGBToBW")
        g.link(colour, grey.inputs[0])
        return g.tinted(colour, look["hue"], look["saturation"], look["value"]), grey.outputs[0]
    at = g.coordinates("World", (1, 1, 1), s)
    fine = g.noise(at, 26.0 * look["scale"], 9, 0.72, look["warp"])
    if look["kind"] == "leaves":
        leaf = g.cells(at, 34.0 * look["scale"], "F1", "Color")
        split = g.node("SeparateColor")
        g.link(leaf, split.inputs[0])
        edge = g.cells(at, 34.0 * look["scale"])
        height = g.math("ADD", g.math("MULTIPLY", edge, -0.6), fine)
        return g.mix(0.5, g.ramp(split.outputs[0], tones, 0.1, 0.9), g.ramp(fine, tones)), height
    if look["kind"] == "stones":
        cell = g.cells(at, 22.0 * look["scale"], "DISTANCE_TO_EDGE")
        height = g.math("ADD", g.step(cell, 0.0, 0.25), g.math("MULTIPLY", fine, 0.5))
        return g.ramp(height, tones, 0.25, 1.2), height
    if look["kind"] == "needles":
        along_x = g.noise(g.coordinates("World", (1, 0.12, 1), s), 60.0, 4, 0.6, 2.0)
        along_y = g.noise(g.coordinates("World", (0.12, 1, 1), s + 2), 60.0, 4, 0.6, 2.0)
        height = g.math(
            "ADD", g.math("MULTIPLY", g.math("MAXIMUM", along_x, along_y), 0.8), g.math("MULTIPLY", fine, 0.4)
        )
        return g.ramp(height, tones, 0.45, 0.8), height
    coarse = g.noise(at, 5.0 * look["scale"], 6, 0.6)
    height = g.math("ADD", g.math("MULTIPLY", coarse, 0.5), g.math("MULTIPLY", fine, 0.5))
    return g.ramp(height, tones), height


def plain(tones: Sequence[Any], scale: float = 6.0, rough: float = 0.9, relief: float = 0.3, metal: float = 0.0) -> Any:
    """Make a simple material of noise between tones, for plants, stones and painted steel."""
    g = Graph("plain")
    at = g.coordinates("Object")
    fleck = g.noise(at, scale, 7, 0.65)
    g.set("Base Color", g.ramp(fleck, tones))
    g.set("Roughness", rough)
    g.set("Metallic", metal)
    if relief:
        g.bump(fleck, relief, 0.02)
    return g.material


def leafy(tones: Sequence[Any]) -> Any:
    """Make blades and leaves: each its own tone, some light shines through."""
    g = Graph("leaf")
    info = g.node("ObjectInfo")
    own = g.math("MULTIPLY", info.outputs["Random"], 0.6)
    fleck = g.math("MULTIPLY", g.noise(g.coordinates("Object"), 12.0, 2), 0.4)
    base = g.ramp(g.math("ADD", own, fleck), tones, 0.1, 0.9)
    g.set("Base Color", base)
    g.set("Roughness", 0.7)
    through = g.node("BsdfTranslucent")
    g.link(base, through.inputs["Color"])
    mixed = g.node("MixShader")
    mixed.inputs[0].default_value = 0.3
    g.link(g.surface.outputs[0], mixed.inputs[1])
    g.link(through.outputs[0], mixed.inputs[2])
    g.link(mixed.outputs[0], g.tree.nodes["Material Output"].inputs[0])
    return g.material
