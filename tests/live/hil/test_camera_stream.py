"""The plant's camera over the socket: the live plant renders on request, and perception accepts the frames."""

import threading
import time

import numpy as np
import pytest

from autonomy.perception.camera.frame import check_frame
from autonomy.perception.sources.stream import StreamCamera
from can_dbc.bus.factory import open_bus
from machine.loading.profile_file import load_profile
from sim.plant import Plant
from sim.process.live_plant import LivePlant


def test_a_live_plant_serves_its_cameras_on_request() -> None:
    profile = load_profile("palms_471")
    plant = Plant(profile, seed=0)
    try:
        with open_bus("virtual:camera-stream") as bus:
            shell = LivePlant(plant, {"crane0": bus}, None, cameras=0)
            assert shell.cameras is not None
            thread = threading.Thread(target=shell.run, daemon=True)
            thread.start()
            camera = StreamCamera(f"127.0.0.1:{shell.cameras.port}", "d435", timeout_s=1.0)
            first = later = None
            end = time.monotonic() + 60.0
            while later is None and time.monotonic() < end:
                frame = camera.frame()
                first, later = (first, frame) if first is not None else (frame, None)
            unknown = StreamCamera(f"127.0.0.1:{shell.cameras.port}", "rear", timeout_s=5.0)
            assert unknown.frame() is None and "stick, d435" in unknown.problem
            unknown.close()
            shell.stop()
            thread.join(10.0)
            camera.close()
            shell.cameras.close()
    finally:
        plant.close()
    assert first is not None and later is not None
    check_frame(first)
    assert first.camera == "d435" and later.stamp_ns > first.stamp_ns
    assert first.rgb.shape == (608, 608, 3) and first.rgb.max() > 60
    assert np.nanmedian(first.depth_m) == pytest.approx(3.1, abs=0.2)
    assert not np.array_equal(first.depth_m, later.depth_m, equal_nan=True)
