"""The newest measured picture for those who watch: small, with the outlines of the masks, encoded only when asked for.

A detector hands over what it has measured anyway; nothing is drawn or encoded until a request arrives
(`can_dbc.messages.picture`), and then once per picture.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
from PIL import Image
from scipy import ndimage

from autonomy.perception.camera.frame import Pose, RgbdFrame, content_window
from autonomy.perception.fitting.measure import Masked
from autonomy.perception.log_list import LogObservation
from can_dbc.messages.picture import (
    MAX_JPEG_BYTES,
    MAX_LOGS,
    PictureFacts,
    PictureLog,
    encode_picture,
    picture_request,
)
from machine.geometry.optics import Intrinsics

SIDE_PX: Final = 640
"""Longest side of the picture that is shown."""
QUALITIES: Final = (80, 65, 50, 35, 20)
"""Of the JPEG, until it fits into a datagram."""
OUTLINE: Final = (255, 225, 77)
HALO: Final = (20, 30, 26)
"""A dark line beside the outline, so that it is seen on bright wood too."""
MIN_DEPTH_M: Final = 0.1


@dataclass(frozen=True, slots=True)
class MeasuredPicture:
    """A frame, the camera's pose in the crane's base frame, the masks in it, and the logs in that frame after it."""

    frame: RgbdFrame
    pose: Pose
    masks: Sequence[Masked]
    logs: Sequence[LogObservation]


def ignore_picture(picture: MeasuredPicture) -> None:
    """Ignore a picture, for a detector that nobody watches."""


class NewestPicture:
    """Keeps the newest measured picture of a camera and answers requests for it."""

    def __init__(self, camera: str) -> None:
        self._camera = camera
        self._measured: MeasuredPicture | None = None
        self._measured_ns = 0
        self._drawn: tuple[PictureFacts, bytes] | None = None

    def keep(self, picture: MeasuredPicture, now_ns: int) -> None:
        """Keep a picture that was measured now."""
        self._measured, self._measured_ns, self._drawn = picture, now_ns, None

    def reply(self, request: bytes, problem: str) -> bytes | None:
        """Return the reply to a request; None when the datagram is not a request for a picture.

        ``problem`` is why the detector has no newer one.
        """
        since_ns = picture_request(request)
        if since_ns is None:
            return None
        if self._measured is None:
            return encode_picture(PictureFacts(1, self._camera, 0, problem))
        if since_ns >= self._measured_ns:
            return encode_picture(PictureFacts(1, self._camera, self._measured_ns, problem))
        if self._drawn is None:
            self._drawn = draw(self._measured, self._measured_ns)
        facts, jpeg = self._drawn
        return encode_picture(msgspec.structs.replace(facts, problem=problem), jpeg)


def draw(picture: MeasuredPicture, now_ns: int) -> tuple[PictureFacts, bytes]:
    """Draw a picture without black bars and return its facts and its JPEG; every ``step``-th pixel of the frame."""
    frame = picture.frame
    top, bottom, left, right = content_window(frame.rgb)
    step = -(-max(bottom - top, right - left) // SIDE_PX)
    shown = (slice(top, bottom, step), slice(left, right, step))
    rgb = frame.rgb[shown].copy()
    outlines = [_outline(one.mask[shown]) for one in picture.masks]
    for lines, colour in zip(zip(*outlines, strict=True), (HALO, OUTLINE), strict=True) if outlines else ():
        for line in lines:
            rgb[line] = colour
    pin = frame.intrinsics
    cx_px, cy_px = (pin.cx_px - left) / step, (pin.cy_px - top) / step
    small = Intrinsics(rgb.shape[1], rgb.shape[0], pin.fx_px / step, pin.fy_px / step, cx_px, cy_px)
    x, y, z = picture.pose.position_m.tolist()
    facts = PictureFacts(
        1,
        frame.camera,
        now_ns,
        "",
        small.width_px,
        small.height_px,
        small.fx_px,
        small.fy_px,
        small.cx_px,
        small.cy_px,
        (x, y, z),
        tuple(picture.pose.rotation.ravel().tolist()),
        tuple(_log(one, picture.pose, small) for one in picture.logs[:MAX_LOGS]),
    )
    return facts, _jpeg(rgb)


def _outline(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels just outside a mask (H, W), and two wide just inside it, because JPEG blurs thinner lines."""
    inside = mask & ~ndimage.binary_erosion(mask, iterations=2, border_value=1)
    outside = ndimage.binary_dilation(mask) & ~mask
    return outside, inside


def _log(log: LogObservation, pose: Pose, pin: Intrinsics) -> PictureLog:
    half = 0.5 * log.length_m * np.asarray(log.axis)
    ends = pose.to_optical(np.asarray(log.center_m) + np.array([-half, half]))
    pixels = None
    if (ends[:, 2] > MIN_DEPTH_M).all():
        (a, b), (c, d) = np.round(pin.project(ends), 1).tolist()
        pixels = ((a, b), (c, d))
    return PictureLog(log.id, pixels, round(log.length_m, 3), round(log.diameter_m, 3), log.seen)


def _jpeg(rgb: np.ndarray) -> bytes:
    for quality in QUALITIES:
        file = io.BytesIO()
        Image.fromarray(rgb).save(file, "JPEG", quality=quality)
        if file.tell() <= MAX_JPEG_BYTES:
            return file.getvalue()
    return _jpeg(np.ascontiguousarray(rgb[::2, ::2]))
