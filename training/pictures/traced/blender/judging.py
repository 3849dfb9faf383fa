"""The judging world: scenes of its own, sharing no generator, mesh, material or photograph with the training's.

``python -m training.pictures.traced.blender.judging FOLDER THREADS NUMBER COUNT PICTURES``.  Only camera and light
controls, the matcher and the file format are common.  Scenes are arranged by hand-written rules, not by physics.
"""

from __future__ import annotations

import math
import random
import sys
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from training.pictures.traced.blender import camera
from training.pictures.traced.blender.matching import matched_depth

SIZE_PX, SAMPLES, VIEW_RAD = 608, 12, math.radians(80.0)
KINDS = ("spruce", "pine", "birch", "grass", "snow", "low sun", "twigs", "mud")
TONES = {
    "spruce": [(0.03, 0.02, 0.015), (0.12, 0.08, 0.06), (0.25, 0.2, 0.17)],
    "pine": [(0.05, 0.025, 0.015), (0.22, 0.11, 0.06), (0.42, 0.24, 0.14)],
    "birch": [(0.04, 0.035, 0.03), (0.55, 0.52, 0.47), (0.7, 0.68, 0.64)],
}


def main(folder: Path, threads: int, number: int, count: int, pictures: int, textures: Path | None) -> None:
    """Draw what is missing of the judging world."""
    target = folder / "pictures"
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for k in range(number, pictures, count):
            file = target / f"judged{k:04d}.npz"
            if file.is_file():
                continue
            camera.keep(file, picture(k, threads, Path(scratch), textures))
            print(f"judged {k}", flush=True)


def picture(k: int, threads: int, scratch: Path, textures: Path | None) -> dict[str, np.ndarray]:
    """Draw picture ``k``: every second one has a second eye."""
    rng = random.Random(f"judging world {k}")
    kind = KINDS[k % len(KINDS)]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    camera.prepare(threads)
    view = _scene(kind, rng, textures)
    camera.light(view["light"])
    camera.aim(view)
    light = camera.shoot(scratch, SAMPLES, k)
    depth, ids = camera.measure(scratch)
    arrays = {
        "light": np.clip(light, 0.0, 6e4).astype(np.float16),
        "depth_m": depth.astype(np.float32),
        "ids": ids,
        "lens": np.array([view["focal_px"], view["focal_px"], view["cx_px"], view["cy_px"]]),
        "kind": np.array(kind),
    }
    if (k // len(KINDS)) % 2:
        camera.aim(view, 0.12)
        arrays["matched_m"] = matched_depth(light, camera.shoot(scratch, SAMPLES, k + 1), view["focal_px"], 0.12, k)
    return arrays


def _scene(kind: str, rng: random.Random, textures: Path | None) -> dict[str, Any]:
    snowy, species = kind == "snow", kind if kind in TONES else rng.choice(list(TONES))
    earth = [(0.02, 0.015, 0.01), (0.07, 0.05, 0.025), (0.05, 0.07, 0.02), (0.12, 0.1, 0.06)]
    if kind == "mud":
        earth = [(0.03, 0.02, 0.015), (0.08, 0.055, 0.04), (0.14, 0.1, 0.07)]
    if kind == "grass":
        earth = [(0.03, 0.035, 0.01), (0.07, 0.1, 0.02), (0.16, 0.16, 0.06)]
    photo = None
    if textures is not None and rng.random() < 0.4:
        photo = (
            textures / "cc0_polyhaven_forest" / rng.choice(("burned_ground_01_diff_2k.jpg", "sparse_grass_diff_2k.jpg"))
        )
    soil = _noisy(
        earth, 2.2, (1, 1, 1), 1.0, photo=None if snowy else photo, snow=rng.uniform(0.5, 0.95) if snowy else 0
    )
    wavy = [(a, f, rng.uniform(0, 6), rng.uniform(0, 6)) for a, f in ((0.05, 0.6), (0.02, 2.0), (0.008, 6.0))]

    def height(x: float, y: float) -> float:
        return sum(a * math.sin(f * x + p) * math.sin(f * y + q) for a, f, p, q in wavy)

    _sheet(height, soil, rng, rut=kind == "mud")
    # Logs: rows upon rows, a fan, single ones, or thrown about.
    how = rng.choice(("rows", "rows", "fan", "apart", "thrown"))
    thick = math.exp(rng.uniform(math.log(0.09), math.log(0.36)))
    long, count, main_azimuth_rad = rng.uniform(1.8, 4.4), rng.randint(1, 9), rng.uniform(-math.pi, math.pi)
    skins = [
        _skin(species if rng.random() < 0.8 else rng.choice(list(TONES)), rng, 0.8 if snowy else 0.0) for _ in range(2)
    ]
    cut = _noisy([(0.45, 0.3, 0.17), (0.6, 0.45, 0.28)], 14.0, (1, 1, 1), 0.1)
    for i in range(count):
        d = min(0.45, max(0.06, thick * rng.uniform(0.7, 1.3)))
        turn, x, y, z = main_azimuth_rad + rng.gauss(0, 0.12), 0.0, 0.0, 0.5 * d
        if how == "rows":
            row, column = divmod(i, 3)
            side = (column - 1 + 0.5 * (row % 2)) * 1.12 * thick
            x, y, z = (
                -side * math.sin(main_azimuth_rad),
                side * math.cos(main_azimuth_rad),
                0.5 * d + 0.88 * thick * row,
            )
            turn = main_azimuth_rad + rng.gauss(0, 0.04)
        elif how == "fan":
            turn, z = main_azimuth_rad + 0.35 * (i - count / 2), 0.5 * d + 0.7 * thick * (i % 3)
        elif how == "apart":
            x, y = rng.uniform(-2.2, 2.2), rng.uniform(-2.0, 2.0)
        else:
            x, y, turn = rng.gauss(0, 0.7), rng.gauss(0, 0.6), rng.uniform(-math.pi, math.pi)
            z = 0.5 * d + 0.6 * thick * (i % 3)
        body = _log(
            0.5 * d, 0.5 * d * rng.uniform(0.75, 0.95), long * rng.uniform(0.9, 1.1), rng, [rng.choice(skins), cut]
        )
        body.rotation_euler = (math.pi / 2 + rng.gauss(0, 0.02), 0.0, turn + math.pi / 2)
        body.location, body.pass_index = (x, y, z + height(x, y) - 0.01), i + 1
    for _ in range(rng.randint(60, 160) if kind == "twigs" else rng.randint(0, 40)):
        r = rng.uniform(0.004, 0.018)
        stick = _log(r, 0.4 * r, rng.uniform(0.3, 1.6), rng, [skins[0]], sides=8, rings=8)
        x, y = rng.uniform(-4, 4), rng.uniform(-4, 4)
        stick.rotation_euler = (math.pi / 2 + rng.gauss(0, 0.06), 0.0, rng.uniform(0, 6.28))
        stick.location = (x, y, height(x, y) + rng.uniform(0.01, 0.08))
    if not snowy:
        _grass(rng, height, 3500 if kind == "grass" else rng.choice((0, 300, 1200)))
    for _ in range(rng.choice((0, 0, 2, 5))):
        distance_m, azimuth_rad = rng.uniform(4.5, 9.0), rng.uniform(0, 6.28)
        tree = _log(rng.uniform(0.1, 0.2), 0.08, 9.0, rng, [skins[-1]])
        tree.location = (distance_m * math.cos(azimuth_rad), distance_m * math.sin(azimuth_rad), 4.2)
    eye_azimuth_rad, reach = rng.uniform(-math.pi, math.pi), rng.uniform(2.4, 5.5)
    eye = np.array([reach * math.cos(eye_azimuth_rad), reach * math.sin(eye_azimuth_rad), rng.uniform(2.0, 2.9)])
    ahead = np.array([rng.gauss(0, 0.3), rng.gauss(0, 0.3), 0.1]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    turn3 = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    up = rng.uniform(4, 12) if kind == "low sun" else rng.uniform(12, 60)
    if rng.random() < 0.25 and kind != "low sun":
        sky = {"sky": "flat", "tone": [0.8, 0.85, 0.92], "sky_strength": 1.0, "sun_strength": 0.3, "sun_angle_rad": 0.5}
    else:
        sky = {"sky": "nishita", "tone": [1, 1, 1], "sky_strength": 0.25, "sun_strength": 3.5, "sun_angle_rad": 0.009}
    lit = {
        **sky,
        "elevation_rad": math.radians(up),
        "azimuth_rad": rng.uniform(-3.1, 3.1),
        "dust": 1.0,
        "sun_tone": [1.0, 0.9, 0.72] if up < 15 else [1.0, 0.97, 0.9],
        "lamps": [],
    }
    return {
        "eye_m": eye.tolist(),
        "turn": turn3.tolist(),
        "focal_px": 0.5 * SIZE_PX / math.tan(0.5 * VIEW_RAD),
        "cx_px": 0.5 * (SIZE_PX - 1),
        "cy_px": 0.5 * (SIZE_PX - 1),
        "width_px": SIZE_PX,
        "height_px": SIZE_PX,
        "light": lit,
    }


def _noisy(
    tones: Any,
    scale: float,
    stretch: Any,
    bump: float,
    coord: str = "Object",
    photo: Path | None = None,
    snow: float = 0.0,
    dashes: bool = False,
) -> Any:
    """Make a material of stretched noise, perhaps with a photograph, lying snow, or the dashes of birch."""
    m = bpy.data.materials.new("m")
    m.use_nodes = True
    t = m.node_tree
    link, base = t.links.new, t.nodes["Principled BSDF"]
    base.inputs["Roughness"].default_value = 0.9
    at, warp = t.nodes.new("ShaderNodeTexCoord"), t.nodes.new("ShaderNodeMapping")
    warp.inputs["Scale"].default_value = stretch
    link(at.outputs[coord], warp.inputs[0])
    n = t.nodes.new("ShaderNodeTexNoise")
    n.inputs["Scale"].default_value, n.inputs["Detail"].default_value = scale, 6.0
    link(warp.outputs[0], n.inputs["Vector"])
    ramp = t.nodes.new("ShaderNodeValToRGB")
    e = ramp.color_ramp.elements
    e[0].position, e[1].position = (0.52, 0.56) if dashes else (0.35, 0.7)
    e[0].color, e[1].color = (*tones[-1 if dashes else 0], 1), (*tones[0 if dashes else -1], 1)
    for i, c in enumerate(tones[1:-1] if not dashes else [], 1):
        e.new(0.35 + 0.35 * i / (len(tones) - 1)).color = (*c, 1)
    link(n.outputs["Fac"], ramp.inputs[0])
    colour = ramp.outputs["Color"]
    if photo is not None:
        image = t.nodes.new("ShaderNodeTexImage")
        image.image = bpy.data.images.load(str(photo), check_existing=True)
        flat = t.nodes.new("ShaderNodeMapping")
        flat.inputs["Scale"].default_value = (0.5, 0.5, 0.5)
        link(at.outputs["Object"], flat.inputs[0])
        link(flat.outputs[0], image.inputs[0])
        colour = image.outputs["Color"]
    if snow:
        normal, parts = t.nodes.new("ShaderNodeNewGeometry"), t.nodes.new("ShaderNodeSeparateXYZ")
        link(normal.outputs["Normal"], parts.inputs[0])
        patch, total = t.nodes.new("ShaderNodeTexNoise"), t.nodes.new("ShaderNodeMath")
        patch.inputs["Scale"].default_value = 2.0
        link(normal.outputs["Position"], patch.inputs["Vector"])
        link(parts.outputs["Z"], total.inputs[0])
        link(patch.outputs["Fac"], total.inputs[1])
        gate = t.nodes.new("ShaderNodeMapRange")
        gate.inputs["From Min"].default_value = 1.75 - 0.7 * snow
        gate.inputs["From Max"].default_value = 1.85 - 0.7 * snow
        link(total.outputs[0], gate.inputs["Value"])
        mixed = t.nodes.new("ShaderNodeMixRGB")
        mixed.inputs["Color2"].default_value = (0.9, 0.92, 0.96, 1)
        link(gate.outputs[0], mixed.inputs["Fac"])
        link(colour, mixed.inputs["Color1"])
        colour = mixed.outputs["Color"]
    link(colour, base.inputs["Base Color"])
    if bump:
        rise = t.nodes.new("ShaderNodeBump")
        rise.inputs["Strength"].default_value, rise.inputs["Distance"].default_value = bump, 0.02
        link(n.outputs["Fac"], rise.inputs["Height"])
        link(rise.outputs[0], base.inputs["Normal"])
    return m


def _skin(species: str, rng: random.Random, snow: float) -> Any:
    gain = rng.uniform(0.7, 1.35)
    tones = [tuple(min(0.8, gain * c) for c in tone) for tone in TONES[species]]
    if species == "birch":
        return _noisy([tones[0], tones[2]], rng.uniform(3.0, 6.0), (1, 1, 9), 0.3, snow=snow, dashes=True)
    return _noisy(tones, rng.uniform(5.0, 9.0), (3, 3, 0.35), 0.9, snow=snow)


def _sheet(height: Any, material: Any, rng: random.Random, rut: bool) -> None:
    n, half = 160, 14.0
    line = np.linspace(-half, half, n)
    jitter = np.random.default_rng(rng.getrandbits(30))
    z = np.array([[height(x, y) for y in line] for x in line]) + jitter.normal(0, 0.006, (n, n))
    if rut:
        z -= 0.15 * np.exp(-(((line[:, None] - 2.2) / 0.35) ** 2)) * np.ones((1, n))
    v = [(float(line[i]), float(line[j]), float(z[i, j])) for i in range(n) for j in range(n)]
    f = [(i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1) for i in range(n - 1) for j in range(n - 1)]
    me = bpy.data.meshes.new("sheet")
    me.from_pydata(v, [], f)
    me.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("sheet", me))


def _log(
    r0: float, r1: float, length: float, rng: random.Random, materials: Any, sides: int = 28, rings: int = 26
) -> Any:
    bumpy, sweep = rng.uniform(0.02, 0.07), rng.uniform(0.0, 0.02)
    a0, a1 = rng.uniform(0, 6.28), rng.uniform(0, 6.28)
    v: list[Any] = []
    f: list[Any] = []
    for i in range(rings + 1):
        t = i / rings
        r, bow = r0 + (r1 - r0) * t, sweep * length * (1 - (2 * t - 1) ** 2)
        for j in range(sides):
            a = 2 * math.pi * j / sides
            s = r * (
                1 + bumpy * math.sin(2 * a + a0) + 0.5 * bumpy * math.sin(3 * a + 5 * t + a1) + rng.gauss(0, 0.012)
            )
            v.append((bow + s * math.cos(a), s * math.sin(a), (t - 0.5) * length))
    for i in range(rings):
        for j in range(sides):
            k = (j + 1) % sides
            f.append((i * sides + j, i * sides + k, (i + 1) * sides + k, (i + 1) * sides + j))
    f += [tuple(range(sides))[::-1], tuple(rings * sides + j for j in range(sides))]
    me = bpy.data.meshes.new("log")
    me.from_pydata(v, [], f)
    for m in materials:
        me.materials.append(m)
    for p in me.polygons:
        p.use_smooth = len(p.vertices) == 4
        p.material_index = 0 if len(p.vertices) == 4 else len(materials) - 1
    thing = bpy.data.objects.new("log", me)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def _grass(rng: random.Random, height: Any, count: int) -> None:
    green = _noisy([(0.05, 0.08, 0.01), (0.18, 0.2, 0.05), (0.3, 0.25, 0.1)], 3.0, (1, 1, 1), 0.0)
    shapes = []
    for _ in range(6):
        v: list[Any] = []
        f: list[Any] = []
        for _ in range(14):
            a, r, h, lean = rng.uniform(0, 6.28), rng.uniform(0, 0.05), rng.uniform(0.06, 0.3), rng.uniform(0.02, 0.15)
            x, y, o = r * math.cos(a), r * math.sin(a), len(v)
            v += [(x - 0.004, y, 0), (x + 0.004, y, 0), (x + lean * math.cos(a), y + lean * math.sin(a), h)]
            f.append((o, o + 1, o + 2))
        me = bpy.data.meshes.new("tuft")
        me.from_pydata(v, [], f)
        me.materials.append(green)
        shapes.append(me)
    shift = rng.uniform(0, 6)
    for i in range(count):
        x, y = rng.uniform(-6, 6), rng.uniform(-6, 6)
        if math.sin(1.3 * x + shift) * math.cos(0.9 * y) < 0.1:
            continue
        o = bpy.data.objects.new("tuft", shapes[i % 6])
        o.location, o.rotation_euler[2] = (x, y, height(x, y)), rng.uniform(0, 6.28)
        o.scale = (rng.uniform(0.5, 1.4),) * 3
        bpy.context.scene.collection.objects.link(o)


if __name__ == "__main__":
    place = Path(sys.argv[6]) if len(sys.argv) > 6 else None
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]), place)
