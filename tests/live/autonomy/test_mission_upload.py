"""A planner that waits for a mission: an upload is taken while the machine rests, and refused with a code otherwise."""

from __future__ import annotations

import hashlib
import os
import socket
import stat
import time
from collections.abc import Iterator
from math import nan
from pathlib import Path

import pytest

from autonomy.missions.folder import MissionFolder
from autonomy.missions.model import MissionError
from autonomy.process.upload import NO_MISSION
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import (
    MissionAction,
    MissionCommand,
    MissionReport,
    MissionUpload,
    decode_mission,
    decode_mission_upload,
    encode_mission_command,
    encode_mission_upload,
)
from machine.status.modes import Mode
from tests.autonomy.mission_checks import EXAMPLES
from tests.autonomy.mission_texts import collection, line
from tests.codes import coded
from tests.live.autonomy.waiting_planner import HASH, planner_process, report_machine
from tests.operator_end import udp_end

KEY = b"key"
PAPER_B = (EXAMPLES / "paper_b.geojson").read_bytes()


class Planner:
    """A planner, with a console played by a socket."""

    def __init__(self, folder: Path, console: socket.socket, *more: str) -> None:
        self.folder, self._console, self._number = folder, console, 0
        self.process = planner_process(console.getsockname()[1], KEY, *more)

    def machine(self, mode: Mode = Mode.STANDBY, speed_m_s: float = 0.0) -> None:
        """The controller reports."""
        report_machine(self.process._link.getsockname(), KEY, mode, speed_m_s)
        self.process.step(time.monotonic_ns())

    def upload(self, name: str = "m.geojson", data: bytes = PAPER_B) -> MissionReport:
        """The report after an upload."""
        digest = hashlib.sha256(data).digest()
        return self._told(lambda n, now: encode_mission_upload(MissionUpload(n, HASH, now, name, digest), KEY))

    def order(self, action: MissionAction) -> MissionReport:
        """The report after a command."""
        return self._told(lambda n, now: encode_mission_command(MissionCommand(n, HASH, now, action), KEY))

    def _told(self, datagram) -> MissionReport:
        self._number += 1
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.sendto(datagram(self._number, time.monotonic_ns()), self.process._commands.getsockname())
        self.process.step(time.monotonic_ns())
        while (report := decode_mission(self._console.recv(65536), KEY)[2]).order != self._number:
            pass
        return report


@pytest.fixture
def planner(tmp_path: Path) -> Iterator[Planner]:
    (tmp_path / "m.geojson").write_bytes(PAPER_B)
    with udp_end(5) as console:
        made = Planner(tmp_path, console, "--missions", str(tmp_path))
        yield made
        made.process.close()


def test_a_mission_is_taken_at_rest_and_waits_for_auto(planner: Planner) -> None:
    assert planner.order(MissionAction.AUTO).refusal == NO_MISSION
    planner.machine()
    report = planner.upload()
    assert (report.refusal, report.refusal_code, len(report.route)) == ("", "", 4)
    assert not report.auto and report.state == "IDLE"
    assert planner.upload().refusal == "", "another one may take its place until it has begun"
    assert planner.order(MissionAction.AUTO).auto
    assert planner.upload().refusal_code == "upload.begun"


@pytest.mark.parametrize(
    ("machine", "code"),
    [
        ((Mode.ARMED, 0.0), "upload.armed"),
        ((Mode.ACTIVE, 0.0), "upload.armed"),
        ((Mode.STANDBY, 0.2), "upload.moving"),
        ((Mode.STANDBY, nan), "upload.moving"),
        (None, "upload.no-report"),
    ],
)
def test_no_mission_is_taken_unless_the_machine_rests(planner: Planner, machine, code: str) -> None:
    if machine:
        planner.machine(*machine)
    report = planner.upload()
    assert (report.refusal_code, report.state) == (code, "WAITING") and report.refusal


def test_a_file_other_than_the_uploaded_one_is_refused(planner: Planner) -> None:
    planner.machine()
    assert planner.upload(data=PAPER_B + b" ").refusal_code == "upload.other-file"
    assert planner.upload("none.geojson").refusal_code == "missions.unreadable"
    os.symlink(EXAMPLES / "paper_b.geojson", planner.folder / "link.geojson")
    assert planner.upload("link.geojson").refusal_code == "missions.unreadable"
    far = collection(line(), line())
    (planner.folder / "two.geojson").write_bytes(far)
    assert planner.upload("two.geojson", far).refusal_code.startswith("mission.")


def test_a_planner_with_a_mission_takes_no_other(tmp_path: Path) -> None:
    with udp_end(5) as console:
        planner = Planner(tmp_path, console, "--mission", str(EXAMPLES / "paper_b.geojson"))
        planner.machine()
        assert planner.upload().refusal_code == "upload.not-awaited"
        planner.process.close()


@pytest.mark.parametrize("name", ["../m.geojson", "a/m.geojson", ".m.geojson", "m.txt", "", "m.geojson\n", "é.geojson"])
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    folder = MissionFolder(tmp_path / "missions")
    for use in (folder.read, lambda n: folder.write(n, b"")):
        with pytest.raises(MissionError, check=coded("missions.name")):
            use(name)
    data = encode_mission_upload(MissionUpload(1, HASH, 2, name, bytes(32)))
    with pytest.raises(DatagramRefused):
        decode_mission_upload(data)


def test_a_folder_keeps_what_it_has(tmp_path: Path) -> None:
    folder = MissionFolder(tmp_path / "missions")
    folder.write("a b-1.geojson", b"1")
    with pytest.raises(MissionError, check=coded("missions.exists")):
        folder.write("a b-1.geojson", b"2")
    assert folder.read("a b-1.geojson") == b"1" and folder.names() == ["a b-1.geojson"]
    folder.write("a b-1.geojson", b"2", replace=True)
    assert folder.read("a b-1.geojson") == b"2" and os.listdir(folder.path) == ["a b-1.geojson"]


def test_the_group_of_the_folder_may_read_a_mission_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        MissionFolder(tmp_path).write("m.geojson", b"1")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "m.geojson").stat().st_mode) == 0o640
