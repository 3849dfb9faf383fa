"""The newest picture in which a detector measured logs, for those who watch: request and reply, over UDP on loopback.

The request is ``{"op":"picture","since_ns":"123"}``.  The reply is one line of JSON (`PictureFacts`) and, when the
picture is newer than ``since_ns``, a line feed and its JPEG, in which the outlines of the masks are drawn.  A reply is
accepted or refused as a whole.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec

from runtime.errors import InputRefused

MAX_JPEG_BYTES: Final = 48_000
MAX_DATAGRAM_BYTES: Final = 65_000
MAX_LOGS: Final = 60
"""Logs that a reply lists: with the JPEG they fit into one datagram."""
MAX_SIDE_PX: Final = 4096
JPEG_START: Final = b"\xff\xd8\xff"

Side = Annotated[int, msgspec.Meta(ge=0, le=MAX_SIDE_PX)]
Pixel = tuple[float, float]


class PictureLog(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A log as it was measured then: number, both ends of its axis in the picture (u, v), none behind the camera, its
    size, and whether this picture shows it."""

    id: int
    ends_px: tuple[Pixel, Pixel] | None
    length_m: float
    diameter_m: float
    seen: bool


class PictureFacts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What belongs to a picture; ``measured_ns`` is 0 before the first one.

    ``measured_ns`` is monotonic.  ``width_px`` to ``cy_px`` are the pinhole of the JPEG.  ``position_m`` (3) and
    ``rotation`` (9, row by row; its columns are the optical axes x right, y down, z forward) are the camera's pose in
    the crane's base frame then.  ``problem`` says why there is no newer picture, empty when nothing is wrong.
    """

    schema: Literal[1]
    camera: str
    measured_ns: Annotated[int, msgspec.Meta(ge=0)]
    problem: str
    width_px: Side = 0
    height_px: Side = 0
    fx_px: float = 0.0
    fy_px: float = 0.0
    cx_px: float = 0.0
    cy_px: float = 0.0
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float, float, float, float, float, float] = (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0)
    logs: Annotated[tuple[PictureLog, ...], msgspec.Meta(max_length=MAX_LOGS)] = ()


class _Request(msgspec.Struct):
    op: Literal["picture"]
    since_ns: str = "0"


_REQUEST: Final = msgspec.json.Decoder(_Request)
_FACTS: Final = msgspec.json.Decoder(PictureFacts)


def encode_picture_request(since_ns: int = 0) -> bytes:
    """Encode a request for the newest picture; its JPEG only if it was measured after ``since_ns``."""
    return msgspec.json.encode(_Request("picture", str(since_ns)))


def picture_request(data: bytes) -> int | None:
    """Decode ``since_ns`` of a request for a picture; None when the datagram is something else."""
    try:
        return int(_REQUEST.decode(data).since_ns)
    except (msgspec.DecodeError, UnicodeDecodeError, ValueError):
        return None


def encode_picture(facts: PictureFacts, jpeg: bytes = b"") -> bytes:
    """Encode a reply, with the JPEG or without."""
    head = msgspec.json.encode(facts)
    return head + b"\n" + jpeg if jpeg else head


def decode_picture(data: bytes) -> tuple[PictureFacts, bytes]:
    """Decode the facts and JPEG (empty without a newer picture) of a reply.

    Raises:
        InputRefused: it is not such a reply.
    """
    head, _, jpeg = data.partition(b"\n")
    try:
        facts = _FACTS.decode(head)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise InputRefused("picture.no-camera", "the log detector works without pictures") from None
    if jpeg and not (jpeg.startswith(JPEG_START) and facts.measured_ns and facts.width_px and facts.height_px):
        raise InputRefused("picture.damaged", "the log detector's picture is damaged; restart the detector")
    return facts, jpeg
