"""Frames over a local stream socket (``can_dbc.messages.rgbd``) from the plant or a camera process on this host.

The client requests the newest frame.  A call never takes longer than its timeout; bytes received by then are kept for
the next call.  The connection is opened again after it breaks or delivers invalid data.
"""

from __future__ import annotations

import contextlib
import socket
import time
from typing import Final

import numpy as np

from autonomy.perception.camera.frame import RgbdFrame
from can_dbc.messages.rgbd import HEADER_BYTES, MM_PER_M, RgbdMessage, decode, decode_header, encode_request
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused

MAX_RECEIVE_BYTES: Final = 1 << 20


class StreamCamera:
    """One camera of a server at ``address``: ``HOST:PORT``, or ``unix:PATH``.

    ``problem`` says why the last call returned no frame, and ``problem_code`` is its code; both are empty when the call
    returned a frame.
    """

    def __init__(self, address: str, camera: str, timeout_s: float = 0.1) -> None:
        self._address, self._camera, self._timeout_s = address, camera, timeout_s
        self._socket: socket.socket | None = None
        self._requested, self._data = False, bytearray()
        self.problem = self.problem_code = ""
        self.asked_ns = 0
        """When the frame that was returned last was asked for; the server takes it at once and draws it afterwards."""

    def frame(self) -> RgbdFrame | None:
        """Return the newest frame, or None with ``problem`` and ``problem_code`` set."""
        end_s = time.monotonic() + self._timeout_s
        try:
            frame = self._receive(end_s)
        except (OSError, InputRefused) as error:
            self.close()
            self.problem = f"no frame of camera {self._camera} from {self._address}: {error or type(error).__name__}"
            self.problem_code = error.code if isinstance(error, InputRefused) else "camera-source.connection"
            return None
        self.problem = self.problem_code = ""
        if frame is None:
            self.problem = f"no frame of camera {self._camera} within {1000 * self._timeout_s:.0f} ms"
            self.problem_code = "camera-source.timeout"
        return frame

    def close(self) -> None:
        """Close the connection; the next call connects again."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
        self._socket, self._requested = None, False
        self._data.clear()

    def _receive(self, end_s: float) -> RgbdFrame | None:
        sock = self._socket or self._connect(end_s)
        if not self._requested:
            sock.settimeout(_left(end_s))
            self.asked_ns = time.monotonic_ns()
            sock.sendall(encode_request(self._camera))
            self._requested = True
        message_bytes = HEADER_BYTES
        while True:
            if len(self._data) >= HEADER_BYTES:
                message_bytes = HEADER_BYTES + decode_header(bytes(self._data[:HEADER_BYTES])).remaining_bytes
            if len(self._data) >= message_bytes > HEADER_BYTES:
                break
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return None
            sock.settimeout(left_s)
            try:
                chunk = sock.recv(min(MAX_RECEIVE_BYTES, message_bytes - len(self._data)))
            except TimeoutError:
                return None
            if not chunk:
                raise ConnectionError("the server closed the connection")
            self._data += chunk
        data = bytes(self._data)
        self._data.clear()
        self._requested = False
        return frame_from_message(decode(data))

    def _connect(self, end_s: float) -> socket.socket:
        if self._address.startswith("unix:"):
            sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            target: str | tuple[str, int] = self._address[5:]
        else:
            host, _, port = self._address.rpartition(":")
            if not host or not port.isdigit():
                raise InputRefused("rgbd.address", f"'{self._address}' is neither HOST:PORT nor unix:PATH")
            sock, target = socket.socket(socket.AF_INET, socket.SOCK_STREAM), (host, int(port))
        sock.settimeout(_left(end_s))
        try:
            sock.connect(target)
        except OSError:
            sock.close()
            raise
        self._socket = sock
        return sock


def _left(end_s: float) -> float:
    return max(1e-3, end_s - time.monotonic())


def frame_from_message(sent: RgbdMessage) -> RgbdFrame:
    """Convert a message to a frame: depth in m, NaN where it is unknown."""
    shape = (sent.height_px, sent.width_px)
    depth_m = np.frombuffer(sent.depth_mm, "<u2").reshape(shape).astype(np.float32) / np.float32(MM_PER_M)
    depth_m[depth_m == 0.0] = np.nan
    pin = Intrinsics(sent.width_px, sent.height_px, sent.fx_px, sent.fy_px, sent.cx_px, sent.cy_px)
    rgb = np.frombuffer(sent.rgb, np.uint8).reshape(*shape, 3)
    return RgbdFrame(sent.camera, sent.stamp_ns, rgb, depth_m, pin)
