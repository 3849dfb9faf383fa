"""A server of one small picture for the bridge's camera: ``python -m tests.live.ros2.frame_server`` prints its port."""

from __future__ import annotations

import json
import socket
from typing import Any

from can_dbc.messages.rgbd import REQUEST_HEADER, RgbdMessage, encode, request_name_bytes

WIDTH, HEIGHT = 64, 48
PICTURE = RgbdMessage(
    "d435",
    1,
    WIDTH,
    HEIGHT,
    40.0,
    40.0,
    32.0,
    24.0,
    bytes([7]) * (3 * WIDTH * HEIGHT),
    (1500).to_bytes(2, "little") * (WIDTH * HEIGHT),
)


def serve(client: Any) -> None:
    """Answer requests until the client is gone."""
    with client:
        while start := client.recv(REQUEST_HEADER.size, socket.MSG_WAITALL):
            client.recv(request_name_bytes(start), socket.MSG_WAITALL)
            client.sendall(encode(PICTURE))


def main() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        print(json.dumps({"port": server.getsockname()[1]}), flush=True)
        while True:
            serve(server.accept()[0])


if __name__ == "__main__":
    main()
