"""The plant's cameras on a socket: rendered on request."""

import time

import numpy as np

from can_dbc.messages.rgbd import HEADER_BYTES, decode
from sim.camera.server import CameraServer
from tests.sim.test_camera_server import Rig, asked


def test_a_picture_is_rendered_on_request_only() -> None:
    rig = Rig()
    server = CameraServer(rig, 0)
    server.serve(1)
    assert rig.drawn == []
    with asked(server, "front") as client:
        client.settimeout(0.01)
        got = b""
        for now_ns in range(2, 2000):
            server.serve(now_ns)
            try:
                got = client.recv(HEADER_BYTES)
                break
            except TimeoutError:
                time.sleep(0.001)
        client.settimeout(10.0)
        got += client.recv(4096)
    frame = decode(got)
    assert len(rig.drawn) == 1 and rig.drawn[0] == ("FRONT", frame.stamp_ns)
    assert (frame.camera, frame.width_px, frame.fx_px) == ("front", 4, 3.0)
    assert np.frombuffer(frame.depth_mm, "<u2").tolist() == [1000, 0, 2000, 65535, 300, 5000, 6000, 7000]
    server.close()
