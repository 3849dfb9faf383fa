"""The wire as a cable between two kernel interfaces that come and go."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from can_dbc.bus.base import Bus
from can_dbc.bus.factory import open_bus
from can_dbc.frame import Frame
from hil.wire.launch import wire_daemon

TIMEOUT_S = 10.0
LEFT, RIGHT = "left0", "right0"


@pytest.fixture
def cable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    if os.geteuid() != 0:
        pytest.skip("making interfaces needs root: timberhand hil vcan --root -- pytest tests/live/vcan")
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    with ExitStack() as made:
        for link in (LEFT, RIGHT):
            add(link)
            made.callback(ip, "link", "delete", link)
        made.enter_context(wire_daemon({"crane0": 1_000_000}, joined={LEFT: "crane0", RIGHT: "crane0"}))
        yield


def add(link: str) -> None:
    ip("link", "add", "dev", link, "type", "vcan")
    ip("link", "set", link, "up")


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@pytest.mark.parametrize("way", ["down", "delete"])
def test_a_lost_interface_rejoins(way: str, cable: None) -> None:
    with open_bus(f"socketcan:{RIGHT}") as right:
        if way == "down":
            ip("link", "set", LEFT, "down")
            ip("link", "set", LEFT, "up")
        else:
            ip("link", "delete", LEFT)
            add(LEFT)
        with open_bus(f"socketcan:{LEFT}") as left:
            assert carries(left, right, 0x101) and carries(right, left, 0x102)


def carries(sender: Bus, receiver: Bus, key: int) -> bool:
    """Sends until a frame has gone through the cable."""
    deadline = time.monotonic() + TIMEOUT_S
    frames: list[Frame] = []
    while key not in [frame.key for frame in frames]:
        assert time.monotonic() < deadline, f"{sender.name} does not reach {receiver.name}"
        sender.send(key, b"")
        time.sleep(0.01)
        receiver.drain(frames)
    return True
