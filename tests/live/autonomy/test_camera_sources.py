"""Sources of frames: frame folders, a ZED with a fake SDK, and a stream with valid and invalid servers."""

import socket
import threading
import time

import numpy as np

from autonomy.perception.sources.stream import StreamCamera
from can_dbc.messages.rgbd import REQUEST_HEADER, RgbdMessage, encode, encode_refusal, request_name_bytes


class Server:
    """Replies to requests on a free port with what ``answers`` returns: bytes, or None to close the connection."""

    def __init__(self, answers) -> None:
        self._answers, self.asked = iter(answers), []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            with client:
                while head := client.recv(REQUEST_HEADER.size):
                    self.asked.append(client.recv(request_name_bytes(head)).decode())
                    parts = next(self._answers, None)
                    if parts is None:
                        break
                    for wait_s, data in parts:
                        time.sleep(wait_s)
                        client.sendall(data)

    def close(self) -> None:
        self._listener.close()


def wire(stamp_ns: int) -> bytes:
    depth = np.array([[0, 1500], [65535, 2]], "<u2")
    return encode(RgbdMessage("front", stamp_ns, 2, 2, 3.0, 3.0, 0.5, 0.5, bytes(range(12)), depth.tobytes()))


def test_the_newest_frame_is_requested_and_unknown_depth_is_nan() -> None:
    server = Server([[(0.0, wire(1))], [(0.0, wire(2))]])
    camera = StreamCamera(server.address, "front", timeout_s=5.0)
    frame, later = camera.frame(), camera.frame()
    assert frame is not None and later is not None and (frame.stamp_ns, later.stamp_ns) == (1, 2)
    assert frame.rgb.tolist()[0][1] == [3, 4, 5] and camera.problem == ""
    assert np.array_equal(frame.depth_m, np.array([[np.nan, 1.5], [65.535, 0.002]], np.float32), equal_nan=True)
    assert server.asked == ["front", "front"]
    camera.close()
    server.close()


def test_a_slow_frame_does_not_block_and_is_not_lost() -> None:
    data = wire(7)
    server = Server([[(0.0, data[:30]), (0.25, data[30:])]])
    camera = StreamCamera(server.address, "front", timeout_s=0.1)
    assert camera.frame() is None and camera.problem_code == "camera-source.timeout"
    frame = None
    for _ in range(100):
        frame = frame or camera.frame()
    assert frame is not None and frame.stamp_ns == 7 and server.asked == ["front"]
    camera.close()
    server.close()


def test_invalid_frames_refusals_and_closed_connections_are_reported_and_the_next_call_connects_again() -> None:
    broken = bytearray(wire(1))
    broken[-1] ^= 1
    server = Server(
        [[(0.0, bytes(broken))], [(0.0, encode_refusal("front", "no such camera"))], None, [(0.0, wire(3))]]
    )
    camera = StreamCamera(server.address, "front", timeout_s=5.0)
    for code in ("rgbd.checksum", "rgbd.refused", "camera-source.connection"):
        assert camera.frame() is None and camera.problem_code == code
    frame = camera.frame()
    assert frame is not None and frame.stamp_ns == 3 and camera.problem == camera.problem_code == ""
    camera.close()
    server.close()
