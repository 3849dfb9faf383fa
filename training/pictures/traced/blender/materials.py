"""Materials of logs (bark of several species, peeled and weathered wood, end grain), of the ground, and of what grows
and lies on it.

A log's object coordinates have z along it, so that bark knows along from around.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from training.pictures.traced.blender.nodes import Graph

SNOW = (0.86, 0.9, 0.95)


def bark(look: Mapping[str, Any]) -> Any:
    """Make a bark's material: ``kind``, ``tones`` (dark to bright), ``seed``, shares of moss, lichen, snow, wet."""
    g = Graph(f"bark {look['kind']}")
    tones, s, kind = look["tones"], look["seed"], look["kind"]
    at = g.coordinates("Object", (1, 1, 1), s)
    colour, height, depth_m = _KINDS[kind](g, look, tones, s)
    # Uneven light and dark over a whole log, as dirt and rubbing leave it.
    colour = g.mix(0.55, colour, g.ramp(g.noise(at, 1.6, 3), [(0.35, 0.33, 0.3), (1, 1, 1)], 0.3, 0.6), "MULTIPLY")
    g.bump(height, look["relief"], depth_m)
    if look["lichen"]:
        spots = g.step(g.noise(g.coordinates("Object", (1, 1, 1), s + 3), 9.0, 4), 0.72 - 0.2 * look["lichen"], 0.75)
        colour = g.mix(g.math("MULTIPLY", spots, 0.8), colour, look["lichen_tone"])
    colour = covered(g, look, colour, s)
    g.set("Base Color", colour)
    g.set("Roughness", 0.95 - 0.6 * look["wet"])
    g.set("Specular IOR Level", 0.2 + 0.5 * look["wet"])
    return g.material


def covered(g: Graph, look: Mapping[str, Any], colour: Any, s: float) -> Any:
    """Cover a colour with moss and snow, which lie on what faces up."""
    if look["moss"]:
        patch = g.noise(g.coordinates("World", (1, 1, 1), s), 4.0, 5)
        share = g.step(g.math("ADD", g.math("MULTIPLY", g.upward(), 0.35), patch), 0.95 - 0.45 * look["moss"], 1.0)
        fuzz = g.noise(g.coordinates("World"), 90.0, 3)
        colour = g.mix(share, colour, g.ramp(fuzz, look["moss_tones"]))
    if look["snow"]:
        patch = g.noise(g.coordinates("World", (1, 1, 1), s + 9), 3.0, 6)
        share = g.step(g.math("ADD", g.upward(), patch), 1.75 - 0.75 * look["snow"], 1.8 - 0.7 * look["snow"])
        colour = g.mix(share, colour, SNOW)
    return colour


def _scaly(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make spruce bark: small flat scales."""
    at = g.coordinates("Object", (1, 1, 0.55), s)
    scales = g.cells(at, look["scale"] * 45.0)
    fine = g.noise(at, look["scale"] * 28.0, 8, 0.7)
    height = g.math("ADD", g.math("MULTIPLY", scales, 0.6), fine)
    return g.ramp(height, tones, 0.45, 1.0), height, 0.006


def _plated(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make the bark of pine and larch: plates between furrows that run along."""
    at = g.coordinates("Object", (1, 1, 0.28), s)
    bent = g.node("VectorMath", operation="ADD")
    wobble = g.node("TexNoise")
    wobble.inputs["Scale"].default_value = 9.0
    g.link(at, wobble.inputs["Vector"])
    g.link(at, bent.inputs[0])
    shrink = g.node("VectorMath", operation="SCALE")
    g.link(wobble.outputs["Color"], shrink.inputs[0])
    shrink.inputs["Scale"].default_value = 0.09
    g.link(shrink.outputs[0], bent.inputs[1])
    edge = g.cells(bent.outputs[0], look["scale"] * 17.0, "DISTANCE_TO_EDGE")
    furrow = g.step(edge, 0.02, 0.22)
    fine = g.noise(g.coordinates("Object", (1, 1, 0.4), s), 40.0, 8, 0.7)
    height = g.math("ADD", furrow, g.math("MULTIPLY", fine, 0.4))
    plate = g.ramp(fine, tones[1:])
    return g.mix(furrow, tones[0], plate), height, 0.014


def _furrowed(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make the bark of old spruce, oak, aspen foot: ridges along the log."""
    at = g.coordinates("Object", (1, 1, 0.13), s)
    ridges = g.noise(at, look["scale"] * 24.0, 9, 0.68, 0.6)
    return g.ramp(ridges, tones, 0.36, 0.64), ridges, 0.018


def _birch(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make white bark with dark dashes around the log and black cracked patches."""
    dash = g.noise(g.coordinates("Object", (1, 1, 9), s), look["scale"] * 5.0, 4, 0.6)
    long_dash = g.noise(g.coordinates("Object", (1, 1, 22), s + 5), look["scale"] * 3.0, 3)
    dark = g.math("MAXIMUM", g.step(dash, 0.6, 0.66), g.math("MULTIPLY", g.step(long_dash, 0.62, 0.66), 0.8))
    patch = g.step(g.noise(g.coordinates("Object", (1, 1, 0.6), s + 2), 4.5, 7, 0.7), 0.6, 0.66)
    pale = g.ramp(g.noise(g.coordinates("Object", (1, 1, 3), s + 1), 6.0, 5), [tones[1], tones[2]])
    colour = g.mix(g.math("MAXIMUM", dark, patch), pale, tones[0])
    return colour, g.math("SUBTRACT", 1.0, g.math("MULTIPLY", patch, 0.8)), 0.006


def _smooth(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make the bark of aspen, alder, beech: smooth, with dark diamonds and pale bands."""
    cells = g.cells(g.coordinates("Object", (1, 1, 0.7), s), look["scale"] * 9.0)
    spots = g.step(cells, 0.2, 0.1)
    bands = g.noise(g.coordinates("Object", (1, 1, 3.5), s), 5.0, 6)
    colour = g.mix(g.math("MULTIPLY", spots, 0.85), g.ramp(bands, tones[1:]), tones[0])
    return colour, g.math("ADD", bands, spots), 0.004


def _peeled(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make wood without bark, with streaks of bast along it."""
    at = g.coordinates("Object", (1, 1, 0.05), s)
    streak = g.noise(at, look["scale"] * 22.0, 8, 0.6)
    rest = g.step(g.noise(g.coordinates("Object", (1, 1, 0.25), s + 4), 5.0, 6), 0.56, 0.6)
    colour = g.mix(g.math("MULTIPLY", rest, look.get("bast", 0.7)), g.ramp(streak, tones[1:]), tones[0])
    return colour, g.math("ADD", streak, rest), 0.004


_KINDS = {
    "scaly": _scaly,
    "plated": _plated,
    "furrowed": _furrowed,
    "birch": _birch,
    "smooth": _smooth,
    "peeled": _peeled,
    "wild": _furrowed,
}


def end_grain(look: Mapping[str, Any]) -> Any:
    """Make a sawn end: rings about the pith, cracks, bright sapwood, a rim of bark."""
    g = Graph("end")
    s, tones = look["seed"], look["end_tones"]
    at = g.coordinates("Object", (1, 1, 0.02), 0.0)
    wave = g.node("TexWave", wave_type="RINGS", rings_direction="Z")
    g.link(at, wave.inputs["Vector"])
    for name, value in (("Scale", look["rings"]), ("Distortion", 1.5), ("Detail", 3.0)):
        wave.inputs[name].default_value = value
    colour = g.ramp(wave.outputs["Fac"], [tones[0], tones[1]], 0.1, 0.9)
    flat = g.node("SeparateXYZ")
    g.link(g.coordinates("Object"), flat.inputs[0])
    radius = g.math(
        "POWER", g.math("ADD", g.math("POWER", flat.outputs["X"], 2.0), g.math("POWER", flat.outputs["Y"], 2.0)), 0.5
    )
    heart = g.step(g.math("DIVIDE", radius, look["radius_m"]), 0.55, 0.35)
    colour = g.mix(g.math("MULTIPLY", heart, look["heart"]), colour, tones[2])
    rim = g.step(g.math("DIVIDE", radius, look["radius_m"]), 0.9, 0.95)
    colour = g.mix(rim, colour, look["tones"][0])
    dirt = g.noise(g.coordinates("Object", (1, 1, 1), s), 7.0, 6)
    colour = g.mix(look["dirt"], colour, g.ramp(dirt, [(0.25, 0.2, 0.15), (1, 1, 1)], 0.35, 0.6), "MULTIPLY")
    g.set("Base Color", covered(g, look, colour, s))
    g.set("Roughness", 0.9 - 0.3 * look["wet"])
    return g.material


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
    """Make colour and height of one kind of soil: of noise in two sizes, cells, or needles."""
    tones: Sequence[Any] = look["tones"]
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
