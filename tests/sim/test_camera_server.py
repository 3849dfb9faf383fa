"""The plant's cameras on a socket: rendered on request, refusals, and no ground truth in the frames."""

import contextlib
import socket
import threading

import numpy as np
import pytest

from can_dbc.messages.rgbd import HEADER_BYTES, RgbdMessage, decode, decode_header, encode_request
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused
from sim.camera.rig import Mount, RgbdFrame
from sim.camera.server import CameraServer, rgbd_message
from tests.codes import coded

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


def answer(client: socket.socket) -> RgbdMessage:
    data = b""
    while len(data) < HEADER_BYTES or len(data) < HEADER_BYTES + decode_header(data[:HEADER_BYTES]).remaining_bytes:
        chunk = client.recv(4096)
        assert chunk
        data += chunk
    return decode(data)


def test_an_unknown_camera_is_refused() -> None:
    server = CameraServer(Rig(), 0)
    with asked(server, "rear") as client, pytest.raises(InputRefused, check=coded("rgbd.refused")):
        answer(client)
    server.close()


def test_a_malformed_request_closes_the_connection() -> None:
    server = CameraServer(Rig(), 0)
    with socket.create_connection(("127.0.0.1", server.port), timeout=10.0) as client:
        client.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with contextlib.suppress(ConnectionResetError):
            assert client.recv(100) == b""
    server.close()


def test_the_true_pose_is_not_sent() -> None:
    sent = rgbd_message(Rig().capture("front", None, 5))
    assert not any("true" in name or "pose" in name for name in type(sent).__slots__)
