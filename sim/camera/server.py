"""The plant's cameras on a local socket (``can_dbc.messages.rgbd``): pictures are rendered on request only.

The plant's loop hands out the scene, which takes no longer than a few steps; a thread per client renders and sends, so
that no client delays the machine's time.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from typing import Protocol

import numpy as np

from can_dbc.messages.rgbd import MM_PER_M, REQUEST_HEADER, RgbdMessage, encode, encode_refusal, request_name_bytes
from runtime.errors import InputRefused
from sim.camera.rig import RgbdFrame
from sim.camera.scene import Scene

ANSWER_TIMEOUT_S = 1.0  # of the plant's loop, towards a client
MAX_CLIENT_COUNT = 4


class Rig(Protocol):
    """The part of a ``CameraRig`` that the server needs."""

    names: tuple[str, ...]

    def scene(self, name: str) -> Scene: ...

    def capture(self, name: str, scene: Scene, now_ns: int) -> RgbdFrame: ...


class CameraServer:
    """Serves the cameras of ``rig`` on a TCP port of the loopback interface (0: any free one, see ``port``).

    Call ``serve`` from the loop that owns the world; ``close`` at the end.

    Raises:
        OSError: the port cannot be used.
    """

    def __init__(self, rig: Rig, port: int) -> None:
        self._rig, self._drawing = rig, threading.Lock()
        self._waiting: queue.SimpleQueue[tuple[str, queue.SimpleQueue[tuple[Scene, int]]]] = queue.SimpleQueue()
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._room = threading.Semaphore(MAX_CLIENT_COUNT)
        self._clients: set[socket.socket] = set()
        threading.Thread(target=self._listen, daemon=True, name="cameras").start()

    def serve(self, now_ns: int) -> None:
        """Hand the present scene to the clients that wait for it."""
        while True:
            try:
                name, answer = self._waiting.get_nowait()
            except queue.Empty:
                return
            answer.put((self._rig.scene(name), now_ns))

    def close(self) -> None:
        """Close the port and all connections."""
        for sock in (self._listener, *tuple(self._clients)):
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
            sock.close()

    def _listen(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if not self._room.acquire(blocking=False):
                client.close()
                continue
            self._clients.add(client)
            threading.Thread(target=self._talk, args=(client,), daemon=True, name="camera client").start()

    def _talk(self, client: socket.socket) -> None:
        try:
            with client:
                while True:
                    name = _read(client, request_name_bytes(_read(client, REQUEST_HEADER.size))).decode(
                        errors="replace"
                    )
                    client.sendall(self._answer(name))
        except (OSError, InputRefused):
            return  # a malformed request ends the connection
        finally:
            self._clients.discard(client)
            self._room.release()

    def _answer(self, name: str) -> bytes:
        if name not in self._rig.names:
            return encode_refusal("none", f"no camera {name!r}; there are: {', '.join(self._rig.names) or 'none'}")
        answer: queue.SimpleQueue[tuple[Scene, int]] = queue.SimpleQueue()
        self._waiting.put((name, answer))
        try:
            scene, now_ns = answer.get(timeout=ANSWER_TIMEOUT_S)
        except queue.Empty:
            return encode_refusal(name, f"the plant did not answer within {ANSWER_TIMEOUT_S:g} s; check that it runs")
        with self._drawing:
            frame = self._rig.capture(name, scene, now_ns)
        return encode(rgbd_message(frame))


def rgbd_message(frame: RgbdFrame) -> RgbdMessage:
    """Pack a frame as it is sent: depth in whole millimetres, no true pose."""
    pin, depth = frame.intrinsics, np.nan_to_num(frame.depth_m * np.float32(MM_PER_M), nan=0.0)
    millimetres = np.clip(np.rint(depth), 0, 65535).astype("<u2")
    size = (pin.width_px, pin.height_px, pin.fx_px, pin.fy_px, pin.cx_px, pin.cy_px)
    return RgbdMessage(frame.name, frame.stamp_ns, *size, frame.rgb.tobytes(), millimetres.tobytes())


def _read(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        chunk = client.recv(count - len(data))
        if not chunk:
            raise ConnectionError
        data += chunk
    return data
