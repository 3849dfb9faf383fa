"""The unit files: checked by systemd's tools, and compared with the settings and the programs that they start."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from autonomy.__main__ import arguments as autonomy_arguments
from autonomy.perception.__main__ import command_line as perception_parser
from console.__main__ import command_line as console_command_line
from controller.plc.__main__ import parser as plc_parser
from controller.process.command import parser as controller_parser
from host.release.gate import LIMIT_NS
from host.release.services import RESUME
from host.release.trees import TRIAL
from host.release.updater import PLACE
from tests.deploy.unit_files import CONF, DEPLOY, EXPOSURE, UNITS, setting, short
from timberhand.cli import app
from timberhand.service_status import NAMES, SERVICE_PAGE
from timberhand.why.stops import SERVICE_STOPS

CREDENTIALS = "/run/credentials"

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing (apt-get install systemd)"
)


def words(unit: Path, **settings: str) -> list[str]:
    """The program's arguments as systemd, and the shell where one is used, expand them with the shipped settings."""
    conf = CONF | settings
    command = setting(unit, "ExecStart")[0]
    script = re.fullmatch(r"/bin/sh -c 'exec \S+ (.*)'", command)
    if script is None:
        found = []
        for word in command.split()[1:]:
            if word.startswith("$") and not word.startswith("${"):
                found += conf[word[1:]].split()
            else:
                found.append(re.sub(r"\$\{(\w+)}", lambda m: conf[m[1]], word).replace("%d", CREDENTIALS))
        return found
    text = script[1].replace("$$", "$").replace("%d", CREDENTIALS).replace("%%", "%")
    folders = {"RUNTIME_DIRECTORY": "/run/timberhand", "STATE_DIRECTORY": "/var/lib/timberhand", "PATH": os.defpath}
    done = subprocess.run(
        ["sh", "-uc", f"printf '%s\\n' {text}"], env=conf | folders, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda u: u.stem)
def test_the_security_exposure_of_every_unit_is_small(unit: Path) -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--no-pager", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    level = re.search(r"Overall exposure level for .*: ([\d.]+)", done.stdout)
    assert level, done.stderr
    assert float(level[1]) <= EXPOSURE[short(unit)] <= 1.5, done.stdout


@needs_systemd
def test_systemd_analyze_reports_no_fault(tmp_path: Path) -> None:
    for unit in (DEPLOY / "units").iterdir():
        text = unit.read_text().replace("/opt/timberhand/current/bin/python", sys.executable)
        (tmp_path / unit.name).write_text(text.replace("/opt/timberhand/current/deploy", str(DEPLOY)))
    done = subprocess.run(
        ["systemd-analyze", "verify", *map(str, sorted(tmp_path.iterdir()))],
        capture_output=True,
        text=True,
        check=False,
    )
    assert [line for line in done.stderr.splitlines() if "timberhand" in line] == []
    assert done.returncode == 0


def test_an_interrupted_update_is_finished_at_the_start_and_only_then() -> None:
    unit = DEPLOY / "units/timberhand-update.service"
    assert setting(unit, "ConditionPathIsSymbolicLink") == [str(PLACE / TRIAL)]
    given = words(unit)
    assert given == ["-P", "-m", "timberhand", "service", "resume"]
    service = get_command(app).commands["service"]  # type: ignore[attr-defined]
    assert "resume" in service.commands
    assert float(setting(unit, "TimeoutStartSec")[0]) > 2 * LIMIT_NS * 1e-9
    assert unit.name == RESUME and unit.name.removesuffix(".service").removeprefix("timberhand-") in NAMES


def test_the_programs_accept_the_arguments_of_their_units() -> None:
    unit = DEPLOY / "units"
    control = words(unit / "timberhand-controller.service")
    assert control[:3] == ["-P", "-m", "controller"]
    options = controller_parser().parse_args(control[3:])
    assert options.bus == [("crane0", "socketcan:crane0")]
    assert options.timing == Path("/run/timberhand/controller.timing")
    reports = {port for _, port in options.report}
    assert reports == {int(CONF[f"{who}_PORT"]) for who in ("PLANNER", "CONSOLE_REPORT", "RECORDER_REPORT")}
    planner = autonomy_arguments(words(unit / "timberhand-autonomy.service")[3:])
    assert planner.controller == ("127.0.0.1", options.setpoint_port)
    assert planner.report_port in reports
    assert {port for _, port in planner.tell} == reports - {planner.report_port}, "page and recorder get its missions"
    page = console_command_line().parse_args(words(unit / "timberhand-console.service")[3:])
    assert (page.bus, page.report_port in reports) == (["crane0=socketcan:crane0"], True)


def test_the_camera_answers_where_planner_and_page_ask() -> None:
    unit = DEPLOY / "units/timberhand-perception.service"
    given = words(unit, PERCEPTION_OPTIONS="--driving", CAMERA="front")
    options = perception_parser().parse_args(given[3:])
    assert given[:3] == ["-P", "-m", "autonomy.perception"]
    assert f"127.0.0.1:{options.port}" == CONF["SCENE"]
    assert (options.camera, options.frames, options.driving) == ("front", "zed", True)
    assert "--camera" not in words(unit)
    planner = autonomy_arguments(words(DEPLOY / "units/timberhand-autonomy.service")[3:])
    assert planner.scene == ("127.0.0.1", options.port)
    assert setting(unit, "ExecCondition") == ["/bin/sh -c 'test -n \"$CAMERA_FRAMES\"'"]


def test_page_and_planner_share_the_folder_of_missions_as_the_settings_show() -> None:
    """The page owns it, the planner is in its group and may read what the page saves, and nobody else sees it."""
    unit, text = DEPLOY / "units", (DEPLOY / "timberhand.conf").read_text()
    shown = {
        name: re.findall(rf"^#   {name}=(--(?:missions|planner) .*)$", text, re.MULTILINE)[0]
        for name in ("AUTONOMY_OPTIONS", "CONSOLE_OPTIONS")
    }
    planner = autonomy_arguments(words(unit / "timberhand-autonomy.service", **shown)[3:])
    page = console_command_line().parse_args(words(unit / "timberhand-console.service", **shown)[3:])
    assert page.missions == planner.missions and page.planner == f"127.0.0.1:{planner.order_port}"
    assert 24700 <= planner.order_port <= 24799 and str(planner.order_port) not in CONF.values()
    console, users = (
        unit / "timberhand-console.service",
        [setting(unit / f"timberhand-{name}.service", "User")[0] for name in ("console", "autonomy")],
    )
    made = f"+/usr/bin/install -d -o {users[0]} -g {users[1]} -m 2750 {page.missions}"
    assert setting(console, "ExecStartPre") == [made]
    assert setting(console, "ReadWritePaths") == [f"-{page.missions}"]


def test_the_plc_bridge_is_off_unless_configured() -> None:
    """And what the settings show as an example, its program understands."""
    unit = DEPLOY / "units/timberhand-plc.service"
    assert CONF["PLC"] == ""
    assert setting(unit, "ExecCondition") == ["/bin/sh -c 'test -n \"$PLC\"'"]
    example = re.findall(r"^#   (--modbus .*)$", (DEPLOY / "timberhand.conf").read_text(), re.MULTILINE)
    options = plc_parser().parse_args(words(unit, PLC=example[0])[3:])
    assert options.bus == "crane0=socketcan:crane0"
    assert options.modbus == ("192.168.7.2", 502) and options.allow_network


def test_the_machine_bus_is_one_setting() -> None:
    for name in ("controller", "guard", "recorder", "console"):
        unit = DEPLOY / f"units/timberhand-{name}.service"
        assert [word for word in words(unit) if "mach0" in word] == []
        given = words(unit, MACHINE_BUS="socketcan:mach0")
        assert given[given.index("mach0=socketcan:mach0") - 1] == "--bus"


def test_every_option_that_the_settings_explain_exists() -> None:
    """And the page lies where everyone looks for it."""
    text = (DEPLOY / "timberhand.conf").read_text()
    text = text.split("# How the controller waits")[1]
    explained = re.findall(r"^#   (--\S+)(?: (\d+))?", text, re.MULTILINE)
    assert len(explained) == 3
    unit = DEPLOY / "units/timberhand-controller.service"
    options = " ".join(" ".join(pair) for pair in explained)
    controller_parser().parse_args(words(unit, CONTROLLER_OPTIONS=options)[3:])
    for name in ("recorder", "console"):
        given = words(DEPLOY / f"units/timberhand-{name}.service")
        assert given[given.index("--timing") + 1] == str(SERVICE_PAGE)


def test_the_stops_of_the_service_lie_where_everyone_looks_for_them() -> None:
    given = words(DEPLOY / "units/timberhand-recorder.service")
    assert given[given.index("--stops") + 1] == str(SERVICE_STOPS) and "--journal" in given


@pytest.mark.parametrize("name", ["controller", "autonomy", "console", "recorder"])
def test_the_key_comes_as_a_credential_and_nobody_names_the_file(name: str) -> None:
    unit = DEPLOY / f"units/timberhand-{name}.service"
    assert setting(unit, "LoadCredential") == ["key:/etc/timberhand/key"]
    given = words(unit)
    assert given[given.index("--key-file") + 1] == f"{CREDENTIALS}/key"
