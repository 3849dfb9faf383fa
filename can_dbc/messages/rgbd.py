"""An RGB-D frame on a local byte stream: a camera server's answer to a request for the newest picture.

A request is ``magic u32 | version u16 | length u16 | camera``; the answer is a frame or a refusal with a sentence.  A
frame is ``magic | version | kind | length of the name | stamp i64 [ns] | width u16 | height u16 | fx fy cx cy f64 [px]
| bytes of the body u32 | CRC-32 u32`` (of all but itself), then the camera's name and the body: rgb, 3 bytes per pixel
in rows, and depth, u16 little-endian millimetres in rows, 0 = unknown.  An incomplete frame is refused as a whole.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import isfinite
from typing import Final

from runtime.errors import InputRefused

MAGIC: Final = 0x54485244  # "THRD"
VERSION: Final = 1
PICTURE, REFUSAL = 1, 2
MAX_SIDE_PX: Final = 4096
"""Longest side of a picture."""
MAX_NAME_BYTES: Final = 64
REQUEST_HEADER: Final = struct.Struct("<IHH")
HEADER: Final = struct.Struct("<IHBBqHH4dI")
CRC: Final = struct.Struct("<I")
HEADER_BYTES: Final = HEADER.size + CRC.size
PIXEL_BYTES: Final = 5
MM_PER_M: Final = 1000.0


@dataclass(frozen=True, slots=True)
class RgbdMessage:
    """A picture: ``rgb`` with 3 bytes, ``depth_mm`` with 2 bytes (u16, 0 = unknown) per pixel, in rows."""

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
class AnswerHeader:
    """The fixed part of an answer; ``remaining_bytes`` follow."""

    kind: int
    name_bytes: int
    stamp_ns: int
    width_px: int
    height_px: int
    pinhole_px: tuple[float, float, float, float]
    remaining_bytes: int
    crc: int


def encode_request(camera: str) -> bytes:
    """Encode the bytes of a request for the newest frame of ``camera``."""
    name = _name(camera)
    return REQUEST_HEADER.pack(MAGIC, VERSION, len(name)) + name


def request_name_bytes(start: bytes) -> int:
    """Read the length of the name that follows a request's header; InputRefused if the bytes are no request."""
    magic, version, length = REQUEST_HEADER.unpack(start)
    if magic != MAGIC or version != VERSION or not 0 < length <= MAX_NAME_BYTES:
        raise InputRefused(
            "rgbd.no-request",
            "the bytes are not a request for a frame; is the other side a camera client of this version?",
        )
    return int(length)


def encode(frame: RgbdMessage) -> bytes:
    """Encode the bytes of a frame; raises InputRefused if its sizes are inconsistent."""
    pixels = frame.width_px * frame.height_px
    if not (0 < frame.width_px <= MAX_SIDE_PX and 0 < frame.height_px <= MAX_SIDE_PX):
        raise InputRefused(
            "rgbd.size",
            f"a picture of {frame.width_px} x {frame.height_px} px cannot be sent; at most {MAX_SIDE_PX} px",
        )
    if len(frame.rgb) != 3 * pixels or len(frame.depth_mm) != 2 * pixels:
        raise InputRefused(
            "rgbd.incomplete",
            f"{len(frame.rgb)} bytes of colour and {len(frame.depth_mm)} of depth are not "
            f"{frame.width_px} x {frame.height_px} px",
        )
    pinhole = (frame.fx_px, frame.fy_px, frame.cx_px, frame.cy_px)
    if not all(map(isfinite, pinhole)):
        raise InputRefused("rgbd.not-finite", "the intrinsics are not finite; correct the camera's calibration")
    name = _name(frame.camera)
    return _packed(PICTURE, name, frame.stamp_ns, frame.width_px, frame.height_px, pinhole, frame.rgb + frame.depth_mm)


def encode_refusal(camera: str, why: str) -> bytes:
    """Encode the bytes of an answer that refuses a request."""
    return _packed(REFUSAL, _name(camera), 0, 0, 0, (0.0, 0.0, 0.0, 0.0), why.encode()[:1000])


def decode_header(data: bytes) -> AnswerHeader:
    """Decode the fixed part of an answer, ``HEADER_BYTES`` long; InputRefused if it is invalid, before more is read."""
    magic, version, kind, name, stamp_ns, width, height, fx, fy, cx, cy, body = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise InputRefused("rgbd.magic", "the bytes are not a frame; is the other side a camera server?")
    if version != VERSION:
        raise InputRefused(
            "rgbd.version",
            f"the frame has version {version}, this side reads {VERSION}; use the same release on both sides",
        )
    if kind not in (PICTURE, REFUSAL) or name > MAX_NAME_BYTES or width > MAX_SIDE_PX or height > MAX_SIDE_PX:
        raise InputRefused("rgbd.kind", f"a frame of kind {kind} with {width} x {height} px is not valid")
    if body != (width * height * PIXEL_BYTES if kind == PICTURE else min(body, 1000)):
        raise InputRefused("rgbd.length", f"a frame of {width} x {height} px cannot have {body} bytes")
    (crc,) = CRC.unpack_from(data, HEADER.size)
    return AnswerHeader(kind, name, stamp_ns, width, height, (fx, fy, cx, cy), name + body, crc)


def decode(data: bytes) -> RgbdMessage:
    """Decode the frame of a complete answer; InputRefused for a refusal, with its sentence, and a damaged answer."""
    if len(data) < HEADER_BYTES:
        raise InputRefused("rgbd.length", f"{len(data)} bytes are too short for a frame")
    head = decode_header(data)
    if len(data) != HEADER_BYTES + head.remaining_bytes:
        raise InputRefused(
            "rgbd.length", f"{len(data)} bytes received, but the header announces {HEADER_BYTES + head.remaining_bytes}"
        )
    if zlib.crc32(memoryview(data)[HEADER_BYTES:], zlib.crc32(data[: HEADER.size])) != head.crc:
        raise InputRefused("rgbd.checksum", "the frame has a wrong checksum")
    body = HEADER_BYTES + head.name_bytes
    try:
        camera = data[HEADER_BYTES:body].decode()
    except UnicodeDecodeError:
        raise InputRefused("rgbd.camera-name", "the camera's name is not UTF-8") from None
    if head.kind == REFUSAL:
        raise InputRefused("rgbd.refused", data[body:].decode(errors="replace"))
    if not head.width_px or not head.height_px or not all(map(isfinite, head.pinhole_px)):
        raise InputRefused(
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
    if not 0 < len(name) <= MAX_NAME_BYTES:
        raise InputRefused(
            "rgbd.camera-name", f"a camera's name has 1 to {MAX_NAME_BYTES} bytes, this one has {len(name)}"
        )
    return name
