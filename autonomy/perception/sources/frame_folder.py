"""A folder of RGB-D frames: ``camera.json`` and, for each frame, ``NNNNNN.png`` with its depth.

``camera.json`` holds the camera's name, the intrinsics, the storage of depth and the stamps of the frames.  Depth is
``NNNNNN.depth.png``, 16-bit whole millimetres, 0 = unknown, or ``NNNNNN.npy``, floating metres, NaN = unknown.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

import msgspec
import numpy as np
from PIL import Image

from autonomy.perception.camera.frame import RgbdFrame
from machine.geometry.optics import Intrinsics
from runtime.errors import LinkError

INDEX: Final = "camera.json"
MM_PER_M: Final = 1000.0


class Index(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of ``camera.json``; one stamp [ns] for each frame."""

    camera: str
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    depth: Literal["png", "npy"]
    stamps_ns: tuple[int, ...]


class FrameFolder:
    """A folder of frames as a source: every call returns the next frame, None after the last.

    Raises:
        LinkError: the folder has no valid index.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._next = Path(folder), 0
        path = self._folder / INDEX
        try:
            self.index = msgspec.json.decode(path.read_bytes(), type=Index)
        except OSError as error:
            raise LinkError(
                "camera-source.no-frame-folder",
                f"{folder} is not a folder of frames: {INDEX} cannot be read ({error.strerror or error})",
            ) from None
        except msgspec.DecodeError as error:
            raise LinkError(
                "camera-source.bad-index", f"{path}: {error}; correct the file or write the folder again"
            ) from None

    def __len__(self) -> int:
        return len(self.index.stamps_ns)

    def frame(self) -> RgbdFrame | None:
        """Return the next frame.

        Raises:
            LinkError: its pictures are missing, unreadable or of another size.
        """
        if self._next == len(self):
            return None
        frame = self.at(self._next)
        self._next += 1
        return frame

    def at(self, number: int) -> RgbdFrame:
        """Read frame ``number``, counted from 0; raise as ``frame`` does."""
        i, stem = self.index, f"{number:06d}"
        try:
            with Image.open(self._folder / f"{stem}.png") as picture:
                rgb = np.asarray(picture.convert("RGB"))
            depth_m = self._depth(stem)
        except (OSError, ValueError) as error:
            raise LinkError(
                "camera-source.bad-frame", f"frame {number} of {self._folder} cannot be read: {error}"
            ) from None
        if rgb.shape[:2] != (i.height_px, i.width_px) or depth_m.shape != rgb.shape[:2]:
            raise LinkError(
                "camera-source.bad-frame-size",
                f"frame {number} of {self._folder} is {rgb.shape[1]} x {rgb.shape[0]} px with depth of shape "
                f"{depth_m.shape}, but {INDEX} states {i.width_px} x {i.height_px} px",
            )
        pin = Intrinsics(i.width_px, i.height_px, i.fx_px, i.fy_px, i.cx_px, i.cy_px)
        return RgbdFrame(i.camera, i.stamps_ns[number], rgb, depth_m, pin)

    def _depth(self, stem: str) -> np.ndarray:
        if self.index.depth == "npy":
            return np.asarray(np.load(self._folder / f"{stem}.npy", allow_pickle=False).astype(np.float32))
        with Image.open(self._folder / f"{stem}.depth.png") as picture:
            depth_m = np.asarray(picture).astype(np.float32) / np.float32(MM_PER_M)
        depth_m[depth_m == 0.0] = np.nan
        return depth_m

    def close(self) -> None:
        """Do nothing: no file is kept open."""


class FrameFolderWriter:
    """Writes a folder of frames; ``close`` writes its index.

    Raises:
        LinkError: the folder already holds frames, or a frame is of another camera than the first.
    """

    def __init__(self, folder: Path, depth: Literal["png", "npy"] = "png") -> None:
        self._folder, self._depth = Path(folder), depth
        if (self._folder / INDEX).exists():
            raise LinkError("camera-source.folder-in-use", f"{folder} already holds frames; choose another folder")
        self._folder.mkdir(parents=True, exist_ok=True)
        self._first: RgbdFrame | None = None
        self._stamps_ns: list[int] = []

    def add(self, frame: RgbdFrame) -> None:
        """Write one frame."""
        reference_frame = self._first or frame
        if (frame.camera, frame.intrinsics) != (reference_frame.camera, reference_frame.intrinsics):
            raise LinkError(
                "camera-source.other-camera",
                f"a frame of camera {frame.camera!r} does not belong in a folder of camera {reference_frame.camera!r} "
                "or has other intrinsics; write it to another folder",
            )
        self._first, stem = reference_frame, f"{len(self._stamps_ns):06d}"
        Image.fromarray(frame.rgb).save(self._folder / f"{stem}.png")
        if self._depth == "npy":
            np.save(self._folder / f"{stem}.npy", frame.depth_m)
        else:
            millimetres = np.clip(np.rint(np.nan_to_num(frame.depth_m, nan=0.0) * MM_PER_M), 0, 65535).astype(np.uint16)
            Image.fromarray(millimetres).save(self._folder / f"{stem}.depth.png")
        self._stamps_ns.append(frame.stamp_ns)

    def close(self) -> None:
        """Write the index, unless no frame was added."""
        if self._first is not None:
            p = self._first.intrinsics
            numbers = (p.width_px, p.height_px, p.fx_px, p.fy_px, p.cx_px, p.cy_px)
            index = Index(self._first.camera, *numbers, self._depth, tuple(self._stamps_ns))
            (self._folder / INDEX).write_bytes(msgspec.json.format(msgspec.json.encode(index)))
