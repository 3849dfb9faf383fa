"""The command lines of the bridge and of its camera: exit codes and sentences."""

from __future__ import annotations

import signal
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.harness.processes import free_udp_ports
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from ros2.__main__ import main
from ros2.camera import main as camera_main


@pytest.fixture
def port() -> str:
    (free,) = free_udp_ports(1)
    return str(free)


@pytest.mark.parametrize(
    "wrong", [["--domain", "233"], ["--domain", "x"], ["--controller", "here"], ["--distribution", "humble"]]
)
def test_usage_errors(port: str, wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--report-port", port, *wrong])
    assert ended.value.code == 2


def test_configuration_errors(port: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "key").write_text("short")
    for wrong in (("--profile", tmp_path / "none.toml"), ("--key-file", tmp_path / "key"), ("--lease-ms", 0)):
        assert main(["--report-port", port, *map(str, wrong)]) == 3
        assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_port_in_use(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", int(port)))
        assert main(["--report-port", port]) == 4
    assert port in capsys.readouterr().err


def test_ctrl_c_while_it_starts_ends_it_with_its_exit_code(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(name: str) -> Profile:
        signal.raise_signal(signal.SIGINT)
        return load_profile(name)

    monkeypatch.setattr("ros2.__main__.load_profile", interrupted)
    monkeypatch.setattr("ros2.__main__.open_node", lambda *_: None)
    monkeypatch.setattr("ros2.__main__.Bridge", lambda *_: SimpleNamespace(busy=False))
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["--report-port", port]) == 130
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(number, handler)


def test_an_interface_that_is_not_there(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--report-port", port, "--domain", "151", "--interface", "192.0.2.1"]) == 4
    assert "192.0.2.1" in capsys.readouterr().err


def test_a_camera_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert camera_main(["--camera", "nose", "--frames", "127.0.0.1:1"]) == 3
    assert "stick, d435" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        camera_main(["--camera", "stick", "--frames", "127.0.0.1:1", "--rate-hz", "0"])
    assert ended.value.code == 2
