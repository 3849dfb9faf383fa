"""The project's own path tracer (``kernel/``): the same scenes as Blender draws, hundreds of times faster on a GPU.

It knows no photographs and no skies but its own; in exchange it draws barks and soils that nobody named.  The library
is compiled on first use: by nvcc for a GPU, by g++ for the processor.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from training.pictures.traced.staging import pieces

# -- Looks as the rows of numbers that the tracer's kernel reads (``struct Look`` in ``kernel/surfaces.h``).


BARK_KINDS: Final = ("scaly", "plated", "furrowed", "birch", "smooth", "peeled", "wild")
KINDS: Final = (*BARK_KINDS, "earth", "leaves", "stones", "needles", "leaf", "paint", "ground")
FLOATS: Final = 102


def packed_look(look: Mapping[str, Any]) -> np.ndarray:
    """Pack a look as FLOATS float32."""
    surface_type = look["what"]
    kind = look["kind"] if surface_type in ("bark", "end") else surface_type
    row = [
        _number(kind),
        look.get("seed", 0.0),
        look.get("scale", 1.0),
        look.get("relief", 0.0),
        look.get("moss", 0.0),
        look.get("lichen", 0.0),
        look.get("snow", 0.0),
        look.get("wet", 0.0),
        look.get("rings", 20.0),
        look.get("heart", 0.0),
        look.get("dirt", 0.0),
        look.get("radius_m", 0.1),
        look.get("bast", 0.0),
        look.get("patch_scale", 1.0),
        look.get("snow_scale", 1.0),
        float(look.get("puddles", False)),
        *look.get("wild", [1.0] * 8),
        *_tones(look.get("tones", []), 4),
        *_tones(look.get("end_tones", []), 3),
        *_tones(look.get("moss_tones", []), 2),
        *look.get("lichen_tone", [0.4, 0.4, 0.4]),
    ]
    for name in ("first", "second"):
        own = look.get(name, {"kind": "earth", "tones": []})
        row += [_number(own["kind"]), own.get("scale", 1.0), own.get("warp", 0.0), 0.0, *_tones(own["tones"], 4)]
        row += [float(max(2, min(4, len(own["tones"])))), *own.get("wild", [1.0] * 8)[:7]]
    return np.array(row, np.float32)


def _number(kind: str) -> float:
    return float(KINDS.index("earth" if kind == "grassy" else kind))


def _tones(tones: Any, count: int) -> list[float]:
    """Return exactly ``count`` colours; the last is repeated."""
    rows = list(tones)[:count] or [[0.3, 0.3, 0.3]]
    rows += [rows[-1]] * (count - len(rows))
    return [float(c) for row in rows for c in row]


# -- The project's own path tracer (``kernel/``)


GPU: Final = Path("/dev/nvidiactl")
SOURCES: Final = Path(__file__).parent / "kernel"
FINE: Final = np.dtype([("normals", "f4", (3, 3)), ("look", "i4"), ("body", "i4"), ("end", "i4")])
BODY: Final = np.dtype([("turn", "f4", 9), ("at", "f4", 3), ("number", "i4")])
LAMP: Final = np.dtype([("at", "f4", 3), ("way", "f4", 3), ("tone", "f4", 3), ("edge", "f4")])
LIGHT: Final = np.dtype(
    [
        ("zenith", "f4", 3),
        ("horizon", "f4", 3),
        ("below", "f4", 3),
        ("sun_way", "f4", 3),
        ("sun_tone", "f4", 3),
        ("sun_edge", "f4"),
        ("glow", "f4"),
        ("backdrop", "f4"),
        ("backdrop_height", "f4"),
        ("backdrop_seed", "f4"),
        ("trees", "f4", 3),
        ("lamps", "f4"),
        ("lamp", LAMP, 4),
    ]
)
VIEW: Final = np.dtype(
    [
        ("eye", "f4", 3),
        ("right", "f4", 3),
        ("down", "f4", 3),
        ("ahead", "f4", 3),
        ("lens", "f4", 4),
        ("size", "i4", 2),
        ("samples", "i4"),
        ("seed", "u4"),
    ]
)


CPU_FLAGS: Final = (
    "-O3",
    "-march=native",
    "-fPIC",
    "-fno-math-errno",
    "-fno-signed-zeros",
    "-fno-trapping-math",
    "-fassociative-math",
    "-freciprocal-math",
)
"""What ``-ffast-math`` allows, one by one: with that word the linker adds code that rounds subnormal numbers to zero in
the thread that loads the library, for everything that the process computes afterwards."""


def compiler() -> str | None:
    """Find the compiler of the tracer: nvcc beside a GPU, otherwise g++, None without either."""
    nvcc = shutil.which("nvcc", path=f"{os.environ.get('PATH', '')}:/usr/local/cuda/bin") if GPU.exists() else None
    return nvcc or shutil.which("g++")


def library(folder: Path) -> ctypes.CDLL:
    """Load the compiled tracer, kept in ``folder``."""
    text = b"".join((SOURCES / name).read_bytes() for name in ("vector.h", "surfaces.h", "tracer.cu"))
    text += " ".join(CPU_FLAGS).encode()
    compiler_path = compiler() or "g++"
    nvcc = Path(compiler_path).name == "nvcc"
    kind = "gpu" if nvcc else "cpu"
    file = folder / f"tracer-{kind}-{hashlib.sha256(text).hexdigest()[:12]}.so"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        draft = file.with_suffix(f".{os.getpid()}.part")
        if nvcc:
            command = [compiler_path, "-O3", "--use_fast_math", "-arch=native", "-Xcompiler", "-fPIC"]
        else:
            command = [compiler_path, "-x", "c++", *CPU_FLAGS]
        subprocess.run([*command, "-shared", "-o", str(draft), str(SOURCES / "tracer.cu")], check=True)
        draft.replace(file)
    tracer_library = ctypes.CDLL(str(file))
    tracer_library.scene_new.restype = ctypes.c_void_p
    return tracer_library


class Tracer:
    """One scene ready to be drawn; ``close`` frees it."""

    def __init__(self, code: ctypes.CDLL, scene: Mapping[str, Any]) -> None:
        self._code = code
        tris, fine, bodies, looks = packed(scene)
        self._scene = ctypes.c_void_p(
            code.scene_new(_at(tris), _at(fine), len(tris), _at(bodies), len(bodies), _at(looks), len(looks))
        )

    def close(self) -> None:
        """Free the scene."""
        if self._scene:
            self._code.scene_free(self._scene)
            self._scene = ctypes.c_void_p()

    def draw(
        self, view: Mapping[str, Any], samples: int, shift_m: float = 0.0, seed: int = 0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw linear light (H, W, 3), optical depth (H, W) [m], NaN for the sky, and numbers (H, W) uint8 of a
        view."""
        turn, view_record = np.array(view["turn"]), np.zeros((), VIEW)
        view_record["eye"] = np.array(view["eye_m"]) + shift_m * turn[:, 0]
        view_record["right"], view_record["down"], view_record["ahead"] = turn.T
        view_record["lens"] = view["focal_px"], view["focal_px"], view["cx_px"], view["cy_px"]
        view_record["size"], view_record["samples"], view_record["seed"] = (
            (view["width_px"], view["height_px"]),
            samples,
            view["seed"] + seed,
        )
        shape = (view["height_px"], view["width_px"])
        light, depth, ids = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8)
        lit = packed_light(view["light"])
        if self._code.render(self._scene, _at(lit), _at(view_record), _at(light), _at(depth), _at(ids)):
            raise RuntimeError("the tracer failed on the GPU")
        return light, depth, ids


def _at(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def packed(scene: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pack triangles (N, 3, 3), their details (N,), bodies (B,) and looks (L, floats) of a scene."""
    tris: list[np.ndarray] = []
    fine: list[np.ndarray] = []
    bodies: list[Any] = []
    looks: list[np.ndarray] = []
    known: dict[str, int] = {}
    cut: dict[int, tuple[Any, ...]] = {}
    for piece in pieces(scene):
        if id(piece.shape) not in cut:
            cut[id(piece.shape)] = (piece.shape, *_triangles(piece.shape))
        _, corners, normals, slots = cut[id(piece.shape)]
        numbers = []
        for look in piece.looks:
            name = repr(look)
            if name not in known:
                known[name] = len(looks)
                looks.append(packed_look(look))
            numbers.append(known[name])
        turn = np.asarray(piece.turn)
        detail = np.zeros(len(corners), FINE)
        detail["normals"] = normals @ turn.T
        slots = np.minimum(slots, len(numbers) - 1)
        detail["look"] = np.array(numbers)[slots]
        detail["body"] = len(bodies)
        detail["end"] = np.array([look["what"] == "end" for look in piece.looks])[slots]
        tris.append((piece.scale * corners @ turn.T + piece.position_m).astype(np.float32))
        fine.append(detail)
        bodies.append((turn.T.ravel(), piece.position_m, piece.number))
    return np.concatenate(tris), np.concatenate(fine), np.array(bodies, BODY), np.stack(looks)


def _triangles(shape: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute corners (N, 3, 3), normals (N, 3, 3) and slots (N,) of a shape's triangles."""
    quad = shape.faces[:, 3] >= 0
    rows = np.concatenate([shape.faces[:, :3], shape.faces[quad][:, [0, 2, 3]]])
    slots, smooth = (np.concatenate([a, a[quad]]) for a in (shape.slot, shape.smooth))
    corners = shape.vertices[rows]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.repeat(flat[:, None], 3, axis=1)
    if smooth.any():
        sums = np.zeros_like(shape.vertices)
        np.add.at(sums, rows[smooth].ravel(), np.repeat(flat[smooth], 3, axis=0))
        if shape.uv is not None:  # the seam of a stem is one place
            _, same = np.unique(shape.vertices.round(6), axis=0, return_inverse=True)
            joined = np.zeros((same.max() + 1, 3))
            np.add.at(joined, same.ravel(), sums)
            sums = joined[same.ravel()]
        normals[smooth] = sums[rows[smooth]]
    size = np.linalg.norm(normals, axis=2, keepdims=True)
    return corners, normals / np.maximum(size, 1e-12), slots


def packed_light(look: Mapping[str, Any]) -> np.ndarray:
    """Pack the light of a view for the kernel."""
    light_record = np.zeros((), LIGHT)
    own = look["own"]
    for name in own:
        light_record[name] = own[name]
    elevation_rad, azimuth_rad = look["elevation_rad"], look["azimuth_rad"]
    light_record["sun_way"] = (
        np.cos(elevation_rad) * np.cos(azimuth_rad),
        np.cos(elevation_rad) * np.sin(azimuth_rad),
        np.sin(elevation_rad),
    )
    lamps: Sequence[Any] = look["lamps"][:4]
    light_record["lamps"] = len(lamps)
    for k, lamp in enumerate(lamps):
        ahead = np.array(lamp["target_m"]) - lamp["at_m"]
        light_record["lamp"][k]["at"], light_record["lamp"][k]["way"] = lamp["at_m"], ahead / np.linalg.norm(ahead)
        light_record["lamp"][k]["tone"], light_record["lamp"][k]["edge"] = (
            np.array(lamp["tone"]) * lamp["watts"] * 0.025,
            0.62,
        )
    return light_record
