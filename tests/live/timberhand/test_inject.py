"""``timberhand inject``: what it lists, refuses, and does to a live run."""

from __future__ import annotations

import select
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from can_dbc.bus.factory import open_bus
from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorCommand
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import read_key, write_key
from hil.faults.live import LiveTarget, inject
from hil.faults.table import make
from hil.faults.wire_faults import BABBLE_KEY
from hil.wire.launch import wire_daemon
from machine.loading.profile_file import load_profile
from tests.codes import numbers_in
from tests.operator_end import udp_end

PALMS = load_profile("palms_471")


def target(**changed: Any) -> LiveTarget:
    parts: dict[str, Any] = {"ports": {"sim": 1, "control": 1}, "buses": {"crane0": "socketcan:can0"}, "pids": {}}
    parts["key_file"] = Path("/nowhere/key")
    return LiveTarget(PALMS, **(parts | changed))


def test_a_process_is_stopped_for_a_while_and_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as process:
        there = target(pids={"autonomy": process.pid})
        assert 0.05 in numbers_in(inject(make("process-stuck", part="planner", length_s=0.05), there))
        assert process.poll() is None
        inject(make("process-off", part="planner"), there)
        assert process.wait(10) == -signal.SIGKILL


def test_forged_datagrams_reach_the_controllers_port_with_the_runs_key(tmp_path: Path) -> None:
    key_file = write_key(tmp_path / "key")
    with udp_end(None) as controller:
        there = target(ports={"control": controller.getsockname()[1]}, key_file=key_file)
        for fault in ("planner-garbage", "planner-arms", "planner-replay"):
            assert fault in inject(make(fault, length_s=0.03), there)
            data = controller.recv(2048)
            if fault != "planner-garbage":
                assert isinstance(decode(data, read_key(key_file)), OperatorCommand)
            while select.select([controller], [], [], 0)[0]:
                controller.recv(2048)


def test_the_wire_damages_frames_of_a_live_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TIMBERHAND_WIRE_DIR", str(tmp_path))
    there = target(buses={"crane0": "wire:crane0"})
    with wire_daemon({"crane0": 1_000_000}), open_bus("wire:crane0") as listener:
        assert "bus-babble" in inject(make("bus-babble", length_s=0.02), there)
        frames: list[Frame] = []
        assert select.select([listener], [], [], 10.0)[0]
        listener.drain(frames)
    assert {frame.key for frame in frames} == {BABBLE_KEY}
