"""A Stereolabs ZED camera through its maker's SDK (``pyzed.sl``), which is installed with the camera, not with us."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.sources.camera_source import SourceError
from machine.geometry.optics import Intrinsics


class ZedCamera:
    """The rectified left picture and the depth registered to it; ``name`` is the camera's in the profile.

    ``sdk`` is ``pyzed.sl`` unless given.  Intrinsics are the SDK's own for the delivered resolution.

    Raises:
        SourceError: the SDK is missing, or the camera cannot be opened.
    """

    def __init__(self, name: str, resolution: str = "HD720", rate_hz: int = 15, sdk: Any = None) -> None:
        self._sl = sl = sdk if sdk is not None else _sdk()
        self._name = name
        settings = sl.InitParameters()
        try:
            settings.camera_resolution = getattr(sl.RESOLUTION, resolution)
        except AttributeError:
            raise SourceError(f"camera {name}: the ZED SDK has no resolution {resolution!r}; use HD720") from None
        settings.camera_fps = rate_hz
        settings.coordinate_units = sl.UNIT.METER
        settings.depth_mode = sl.DEPTH_MODE.ULTRA
        self._camera = sl.Camera()
        state = self._camera.open(settings)
        if state != sl.ERROR_CODE.SUCCESS:
            raise SourceError(f"camera {name} cannot be opened: {state}; is it plugged in and used by nobody else?")
        configuration = self._camera.get_camera_information().camera_configuration
        left, size = configuration.calibration_parameters.left_cam, configuration.resolution
        pin = Intrinsics(int(size.width), int(size.height), *(float(v) for v in (left.fx, left.fy, left.cx, left.cy)))
        self._pin = pin
        self._picture, self._depth = sl.Mat(), sl.Mat()

    def frame(self) -> RgbdFrame | None:
        """The next frame; None when the camera had none in time.

        Raises:
            SourceError: the camera is gone.
        """
        sl, camera = self._sl, self._camera
        state = camera.grab()
        if state != sl.ERROR_CODE.SUCCESS:
            if camera.is_opened():
                return None
            raise SourceError(f"camera {self._name} is gone: {state}; check its cable")
        camera.retrieve_image(self._picture, sl.VIEW.LEFT)
        camera.retrieve_measure(self._depth, sl.MEASURE.DEPTH)
        bgra, depth = self._picture.get_data(), np.array(self._depth.get_data(), np.float32)
        # The SDK marks what is too near, too far and occluded by -inf, +inf and NaN.
        depth[~np.isfinite(depth) | (depth <= 0.0)] = np.nan
        rgb = np.ascontiguousarray(bgra[..., 2::-1])
        stamp_ns = int(camera.get_timestamp(sl.TIME_REFERENCE.IMAGE).get_nanoseconds())
        return RgbdFrame(self._name, stamp_ns, rgb, depth, self._pin)

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()


def _sdk() -> Any:
    try:
        return import_module("pyzed.sl")
    except ImportError:
        raise SourceError("a ZED camera needs its maker's SDK with its Python API (pyzed); install both") from None
