"""A camera's pictures: colour, depth (REP 118: u16 mm, 0 is unknown) and the calibration of both."""

from __future__ import annotations

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame
from can_dbc.messages.rgbd import MM_PER_M
from ros2.interfaces.builtin import Header, time_of
from ros2.interfaces.sensor import CameraInfo, Image, RegionOfInterest
from ros2.report.transforms import camera_frame

_DEPTH_MAX_MM = 65535


def colour_image(frame: RgbdFrame, stamp_ns: int) -> Image:
    """The picture; ``stamp_ns`` is its time since the epoch."""
    height, width, _ = frame.rgb.shape
    return Image(_header(frame, stamp_ns), height, width, "rgb8", 0, 3 * width, frame.rgb.tobytes())


def depth_image(frame: RgbdFrame, stamp_ns: int) -> Image:
    """The depth of the same pixels."""
    height, width = frame.depth_m.shape
    millimetres = np.clip(np.nan_to_num(np.rint(frame.depth_m * MM_PER_M)), 0, _DEPTH_MAX_MM).astype("<u2")
    return Image(_header(frame, stamp_ns), height, width, "16UC1", 0, 2 * width, millimetres.tobytes())


def camera_info(frame: RgbdFrame, stamp_ns: int) -> CameraInfo:
    """The pinhole of both, which are rectified: no distortion is left."""
    pin = frame.intrinsics
    k = [pin.fx_px, 0.0, pin.cx_px, 0.0, pin.fy_px, pin.cy_px, 0.0, 0.0, 1.0]
    p = [pin.fx_px, 0.0, pin.cx_px, 0.0, 0.0, pin.fy_px, pin.cy_px, 0.0, 0.0, 0.0, 1.0, 0.0]
    r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    whole = RegionOfInterest(0, 0, 0, 0, False)
    return CameraInfo(
        _header(frame, stamp_ns), pin.height_px, pin.width_px, "plumb_bob", [0.0] * 5, k, r, p, 0, 0, whole
    )


def _header(frame: RgbdFrame, stamp_ns: int) -> Header:
    return Header(time_of(stamp_ns), camera_frame(frame.camera))
