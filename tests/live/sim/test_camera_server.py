"""The plant's cameras on a socket: rendered on request, refusals, and no ground truth in the frames."""

import socket
import threading
import time

import numpy as np

from can_dbc.messages.rgbd import HEADER_BYTES, decode, encode_request
from machine.geometry.optics import Intrinsics
from sim.camera.rig import Mount, RgbdFrame
from sim.camera.server import CameraServer

PIN = Intrinsics(4, 2, 3.0, 3.0, 1.5, 0.5)


class Rig:
    names = ("front",)

    def __init__(self) -> None:
        self.drawn: list[tuple[object, int]] = []

    def scene(self, name: str) -> object:
        assert threading.current_thread() is threading.main_thread()  # only the loop may touch the physics
        return name.upper()

    def capture(self, name: str, scene: object, now_ns: int) -> RgbdFrame:
        self.drawn.append((scene, now_ns))
        depth = np.array([[1.0, np.nan, 2.0004, 99.0], [0.3, 5.0, 6.0, 7.0]], np.float32)
        rgb = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
        return RgbdFrame(name, now_ns, rgb, depth, PIN, Mount("front", (0, 0, 0), (0, 0, 0)), np.ones(3), np.eye(3))


def asked(server: CameraServer, camera: str) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", server.port), timeout=10.0)
    client.sendall(encode_request(camera))
    return client


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
