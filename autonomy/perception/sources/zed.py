"""A Stereolabs ZED camera through its manufacturer's SDK (``pyzed.sl``), which is not installed with this package."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame
from machine.geometry.optics import Intrinsics
from runtime.errors import LinkError


class ZedCamera:
    """The rectified left picture and the depth registered to it; ``name`` is the camera's name in the profile.

    ``sdk`` defaults to ``pyzed.sl``.  The intrinsics are the SDK's for the delivered resolution.  A camera that was
    disconnected is opened again by the next call of `frame` at which it is there.

    Raises:
        LinkError: the SDK is missing, or the camera cannot be opened.
    """

    def __init__(self, name: str, resolution: str = "HD720", rate_hz: int = 15, sdk: Any = None) -> None:
        self._sl = sl = sdk if sdk is not None else _sdk()
        self._name = name
        settings = sl.InitParameters()
        try:
            settings.camera_resolution = getattr(sl.RESOLUTION, resolution)
        except AttributeError:
            raise LinkError(
                "camera-source.no-resolution", f"camera {name}: the ZED SDK has no resolution {resolution!r}; use HD720"
            ) from None
        settings.camera_fps = rate_hz
        settings.coordinate_units = sl.UNIT.METER
        settings.depth_mode = sl.DEPTH_MODE.ULTRA
        self._settings, self._camera = settings, sl.Camera()
        self._picture, self._depth = sl.Mat(), sl.Mat()
        self._open()

    def _open(self) -> None:
        state = self._camera.open(self._settings)
        if state != self._sl.ERROR_CODE.SUCCESS:
            raise LinkError(
                "camera-source.not-opened",
                f"camera {self._name} cannot be opened: {state}; check its cable and that no other process uses it",
            )
        configuration = self._camera.get_camera_information().camera_configuration
        left, size = configuration.calibration_parameters.left_cam, configuration.resolution
        pin = Intrinsics(int(size.width), int(size.height), *(float(v) for v in (left.fx, left.fy, left.cx, left.cy)))
        self._pin, self._lost = pin, False

    def frame(self) -> RgbdFrame | None:
        """Return the next frame; None when the camera delivered none in time.

        Raises:
            LinkError: the camera is disconnected, or not back yet.
        """
        sl, camera = self._sl, self._camera
        if self._lost:
            self._open()
        state = camera.grab()
        if state != sl.ERROR_CODE.SUCCESS:
            if camera.is_opened():
                return None
            self._lost = True
            camera.close()
            raise LinkError(
                "camera-source.disconnected", f"camera {self._name} is disconnected: {state}; check its cable"
            )
        camera.retrieve_image(self._picture, sl.VIEW.LEFT)
        camera.retrieve_measure(self._depth, sl.MEASURE.DEPTH)
        bgra, depth = self._picture.get_data(), np.array(self._depth.get_data(), np.float32)
        # The SDK marks pixels that are too near, too far or occluded with -inf, +inf and NaN.
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
        raise LinkError(
            "camera-source.no-sdk", "a ZED camera needs the ZED SDK with its Python API (pyzed); install both"
        ) from None
