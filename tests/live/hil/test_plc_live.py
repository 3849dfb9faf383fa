"""The PLC path as processes in real time, and the usage errors of bridge and emulated PLC."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from hil.plc import write_plc_profile
from hil.wire.launch import wire_daemon


def run(*arguments: str, timeout: float = 60.0, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        stdin=subprocess.DEVNULL,
        env=os.environ | environment,
    )


@pytest.mark.timeout(400)
def test_a_log_lands_in_the_bunk_over_modbus(tmp_path: Path) -> None:
    """What is asserted is the outcome; a host that is short of processor time stops the machine, rightly."""
    arguments = ["demo", "--detector", "perfect", "--plc", "--bus", "wire", "--live", "--no-console", "--json"]
    arguments += ["--max-stops", "60", "--limit-s", "300"]
    done = run("timberhand", *arguments, "--out", str(tmp_path / "run"), timeout=380, TIMBERHAND_WIRE_DIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["in_bunk"]
    plc = json.loads((tmp_path / "run" / "plc.err").read_text().split("plc: ", 1)[1])
    sim = json.loads((tmp_path / "run" / "sim.err").read_text().split("plc: ", 1)[1])
    assert plc["refused_here"] == sim["malformed"] == sim["evicted"] == 0
    assert sim["accepted"] > 2000 and plc["round_trip"]["count"] > 2000


@pytest.mark.parametrize("module", ["controller.plc", "sim.plc"])
def test_only_loopback_addresses_are_accepted_by_default(module: str, tmp_path: Path) -> None:
    profile = str(write_plc_profile("palms_471", "valves", tmp_path))
    done = run(module, "--profile", profile, "--modbus", "192.0.2.1:502")
    assert done.returncode == 2 and "--allow-network" in done.stderr


@pytest.mark.parametrize(("module", "host"), [("controller.plc", "192.0.2.1"), ("sim.plc", "0.0.0.0")])
def test_datagrams_on_a_network_need_a_key(module: str, host: str, tmp_path: Path) -> None:
    profile = str(write_plc_profile("palms_471", "valves", tmp_path))
    done = run(module, "--profile", profile, "--udp", f"{host}:1503", "--allow-network")
    assert done.returncode == 2 and "--key-file" in done.stderr and "--no-key" in done.stderr
    short = tmp_path / "key"
    short.write_text("too short")
    done = run(module, "--profile", profile, "--udp", f"{host}:1503", "--allow-network", "--key-file", str(short))
    assert done.returncode == 3 and "Traceback" not in done.stderr


def test_what_is_not_authenticated_on_a_network_is_warned_of(tmp_path: Path) -> None:
    """There is no bus here, so it ends after the warning."""
    profile = str(write_plc_profile("palms_471", "valves", tmp_path))
    for link in (["--udp", "192.0.2.1:1503", "--no-key"], ["--modbus", "192.0.2.1:502"]):
        done = run(
            "controller.plc",
            "--profile",
            profile,
            "--bus",
            "crane0=wire:none",
            *link,
            "--allow-network",
            TIMBERHAND_WIRE_DIR=str(tmp_path),
        )
        assert done.returncode == 4 and "warning" in done.stderr
    done = run("controller.plc", "--profile", profile, "--modbus", "127.0.0.1:502", "--key-file", str(tmp_path / "key"))
    assert done.returncode == 2 and "--key-file" in done.stderr


@pytest.mark.parametrize("module", ["controller.plc", "sim.plc"])
def test_a_profile_without_a_plc_is_refused(module: str) -> None:
    done = run(module, "--profile", "palms_471", "--modbus", "127.0.0.1:1502")
    assert done.returncode == 3 and "[plc]" in done.stderr and "Traceback" not in done.stderr


def test_the_link_to_the_plc_is_a_required_option() -> None:
    assert run("controller.plc", "--profile", "palms_471").returncode == 2
    assert run("sim.plc", "--profile", "palms_471").returncode == 2


def test_the_bridge_reports_its_status_to_systemd_although_no_plc_answers(tmp_path: Path) -> None:
    """It is ready when it is on the bus; what the PLC does stands in its status."""
    profile = str(write_plc_profile("palms_471", "valves", tmp_path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, wire_daemon({"crane0": 1_000_000}, tmp_path):
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(20.0)
        bridge = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "controller.plc",
                "--profile",
                profile,
                "--bus",
                "crane0=wire:crane0",
                "--modbus",
                "127.0.0.1:1",
                "--no-realtime",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify"), "TIMBERHAND_WIRE_DIR": str(tmp_path)},
        )
        try:
            first = systemd.recv(4096).decode()
            assert first.startswith("READY=1\nWATCHDOG=1\nSTATUS=") and "PLC" in first and "ACTIVE" in first
            assert systemd.recv(4096).decode().startswith("WATCHDOG=1")
            bridge.send_signal(signal.SIGTERM)
            while (last := systemd.recv(4096).decode()).startswith("WATCHDOG=1"):
                pass
            assert last.startswith("STOPPING=1")
            assert bridge.wait(10.0) == 0
        finally:
            bridge.kill()
            bridge.wait()
