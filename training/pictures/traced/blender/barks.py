"""Materials of logs: bark of several species, peeled and weathered wood, end grain.

A log's object coordinates have z along it, so that bark knows along from around.
"""

from __future__ import annotations

from collections.abc import Mapping
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


def _photo(g: Graph, look: Mapping[str, Any], tones: Any, s: float) -> tuple[Any, Any, float]:
    """Make a photographed bark, wrapped around the log by its texture coordinates."""
    texture_uv = g.node("TexCoord").outputs["UV"]
    moved = g.node("Mapping")
    g.link(texture_uv, moved.inputs["Vector"])
    moved.inputs["Scale"].default_value = (look["repeat"], 0.8 * look["scale"], 1.0)
    moved.inputs["Location"].default_value = (s, 0.37 * s, 0.0)
    colour = g.image(look["image"], moved.outputs["Vector"])
    grey = g.node("RGBToBW")
    g.link(colour, grey.inputs[0])
    return g.tinted(colour, look["hue"], look["saturation"], look["value"]), grey.outputs[0], 0.012


_KINDS = {
    "scaly": _scaly,
    "plated": _plated,
    "furrowed": _furrowed,
    "birch": _birch,
    "smooth": _smooth,
    "peeled": _peeled,
    "photo": _photo,
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
