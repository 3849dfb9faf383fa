"""An RGB-D frame on a local byte stream: what a camera answers when it is asked for its newest picture.

A question is ``magic u32 | version u16 | length u16 | camera``; the answer a frame or a refusal with a sentence.  A
frame is ``magic | version | kind | length of the name | stamp i64 [ns] | width u16 | height u16 | fx fy cx cy f64 [px]
| bytes of the body u32 | CRC-32 u32`` (of all but itself), then the camera's name and the body: rgb, 3 bytes a pixel in
rows, and depth, u16 little-endian millimetres in rows, 0 = unknown.  A frame that is not whole is refused whole.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import isfinite
from typing import Final

from runtime.errors import CodedError

MAGIC: Final = 0x54485244  # "THRD"
VERSION: Final = 1
PICTURE, REFUSAL = 1, 2
MOST_PX: Final = 4096
"""A side of the largest picture."""
MOST_NAME: Final = 64
QUESTION: Final = struct.Struct("<IHH")
HEADER: Final = struct.Struct("<IHBBqHH4dI")
CRC: Final = struct.Struct("<I")
START_BYTES: Final = HEADER.size + CRC.size
PIXEL_BYTES: Final = 5
MM_M: Final = 1000.0


class RgbdError(CodedError, ValueError):
    """Bytes that are no frame, or a frame that cannot be sent; the message says what is wrong."""


@dataclass(frozen=True, slots=True)
class RgbdMessage:
    """``rgb`` 3 bytes and ``depth_mm`` 2 bytes (u16, 0 = unknown) a pixel, in rows; intrinsics in px."""

    camera: str
    stamp_ns: int
    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    rgb: bytes
    depth_mm: bytes


@dataclass(frozen=True, slots=True)
class Start:
    """The fixed part of an answer: ``rest`` bytes follow."""

    kind: int
    name_bytes: int
    stamp_ns: int
    width_px: int
    height_px: int
    pinhole_px: tuple[float, float, float, float]
    rest: int
    crc: int


def encode_question(camera: str) -> bytes:
    """The bytes that ask a server for the newest frame of ``camera``."""
    name = _name(camera)
    return QUESTION.pack(MAGIC, VERSION, len(name)) + name


def question_bytes(start: bytes) -> int:
    """How many bytes of name follow ``QUESTION.size`` bytes; raises RgbdError when they begin no question."""
    magic, version, length = QUESTION.unpack(start)
    if magic != MAGIC or version != VERSION or not 0 < length <= MOST_NAME:
        raise RgbdError(
            "rgbd.no-request", "these bytes ask for no frame; is the other side a camera client of this version?"
        )
    return int(length)


def encode(frame: RgbdMessage) -> bytes:
    """The bytes of a frame; raises RgbdError when its sizes do not agree."""
    pixels = frame.width_px * frame.height_px
    if not (0 < frame.width_px <= MOST_PX and 0 < frame.height_px <= MOST_PX):
        raise RgbdError(
            "rgbd.size", f"a picture of {frame.width_px} x {frame.height_px} px cannot be sent; at most {MOST_PX} px"
        )
    if len(frame.rgb) != 3 * pixels or len(frame.depth_mm) != 2 * pixels:
        raise RgbdError(
            "rgbd.incomplete",
            f"{len(frame.rgb)} bytes of colour and {len(frame.depth_mm)} of depth are no "
            f"{frame.width_px} x {frame.height_px} px",
        )
    pinhole = (frame.fx_px, frame.fy_px, frame.cx_px, frame.cy_px)
    if not all(map(isfinite, pinhole)):
        raise RgbdError("rgbd.not-finite", "intrinsics that are not finite cannot be sent")
    name = _name(frame.camera)
    return _packed(PICTURE, name, frame.stamp_ns, frame.width_px, frame.height_px, pinhole, frame.rgb + frame.depth_mm)


def encode_refusal(camera: str, why: str) -> bytes:
    """The bytes of an answer that is no frame."""
    return _packed(REFUSAL, _name(camera), 0, 0, 0, (0.0, 0.0, 0.0, 0.0), why.encode()[:1000])


def start(data: bytes) -> Start:
    """The fixed part of an answer, ``START_BYTES`` long; raises RgbdError when it is none, before anything is read on
    its word."""
    magic, version, kind, name, stamp_ns, width, height, fx, fy, cx, cy, body = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise RgbdError("rgbd.magic", "these bytes begin no frame; is the other side a camera server?")
    if version != VERSION:
        raise RgbdError(
            "rgbd.version", f"a frame of version {version}, but this side knows {VERSION}; use the same release on both"
        )
    if kind not in (PICTURE, REFUSAL) or name > MOST_NAME or width > MOST_PX or height > MOST_PX:
        raise RgbdError("rgbd.kind", f"a frame of kind {kind} and {width} x {height} px, which none is")
    if body != (width * height * PIXEL_BYTES if kind == PICTURE else min(body, 1000)):
        raise RgbdError("rgbd.length", f"a frame of {width} x {height} px with {body} bytes, which do not fit")
    (crc,) = CRC.unpack_from(data, HEADER.size)
    return Start(kind, name, stamp_ns, width, height, (fx, fy, cx, cy), name + body, crc)


def decode(data: bytes) -> RgbdMessage:
    """The frame of a whole answer; raises RgbdError for a refusal, with its sentence, and for anything broken."""
    if len(data) < START_BYTES:
        raise RgbdError("rgbd.length", f"{len(data)} bytes are no frame")
    head = start(data)
    if len(data) != START_BYTES + head.rest:
        raise RgbdError("rgbd.length", f"{len(data)} bytes where a frame of {START_BYTES + head.rest} was announced")
    if zlib.crc32(memoryview(data)[START_BYTES:], zlib.crc32(data[: HEADER.size])) != head.crc:
        raise RgbdError("rgbd.checksum", "a frame whose checksum is wrong")
    body = START_BYTES + head.name_bytes
    try:
        camera = data[START_BYTES:body].decode()
    except UnicodeDecodeError:
        raise RgbdError("rgbd.camera-name", "a frame whose camera has no name") from None
    if head.kind == REFUSAL:
        raise RgbdError("rgbd.refused", data[body:].decode(errors="replace"))
    if not head.width_px or not head.height_px or not all(map(isfinite, head.pinhole_px)):
        raise RgbdError(
            "rgbd.intrinsics", f"a frame of {head.width_px} x {head.height_px} px with intrinsics {head.pinhole_px}"
        )
    split = body + 3 * head.width_px * head.height_px
    return RgbdMessage(
        camera, head.stamp_ns, head.width_px, head.height_px, *head.pinhole_px, data[body:split], data[split:]
    )


def _packed(
    kind: int,
    name: bytes,
    stamp_ns: int,
    width: int,
    height: int,
    pinhole: tuple[float, float, float, float],
    body: bytes,
) -> bytes:
    header = HEADER.pack(MAGIC, VERSION, kind, len(name), stamp_ns, width, height, *pinhole, len(body))
    return b"".join((header, CRC.pack(zlib.crc32(body, zlib.crc32(name, zlib.crc32(header)))), name, body))


def _name(camera: str) -> bytes:
    name = camera.encode()
    if not 0 < len(name) <= MOST_NAME:
        raise RgbdError("rgbd.camera-name", f"a camera's name has 1 to {MOST_NAME} bytes, not {len(name)}")
    return name
