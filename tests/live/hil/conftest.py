"""Buses for the tests of the contract: one of every kind, and a wire daemon."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hil.wire.core import WireCore
from hil.wire.launch import wire_daemon
from tests.live.hil.bus_backends import BITRATE, Backend, kernel_interface


@pytest.fixture(scope="module")
def wire_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    directory = tmp_path_factory.mktemp("wire")
    with wire_daemon({"fast": BITRATE, "lone": BITRATE}, directory):
        yield directory


@pytest.fixture(params=["in-process", "wire", "socketcan", "python-can", "virtual", "plugin"])
def backend(request: pytest.FixtureRequest, wire_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Backend]:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(wire_dir))
    name = request.param
    if name == "in-process":
        backend = Backend(name, core=WireCore(BITRATE))
    elif name == "socketcan":
        backend = Backend(name, f"socketcan:{kernel_interface()}")
    elif name == "python-can":
        backend = Backend(name, f"python-can:socketcan:{kernel_interface()}")
    else:
        channel = request.node.name if name == "virtual" else "fast"
        backend = Backend(name, f"{'timberhand' if name == 'plugin' else name}:{channel}")
    yield backend
    for bus in backend.opened:
        bus.close()
