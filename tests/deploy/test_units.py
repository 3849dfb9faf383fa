"""The unit files: checked by systemd's tools, and compared with the settings and the programs that they start."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from autonomy.__main__ import arguments as autonomy_arguments
from controller.plc.__main__ import parser as plc_parser
from controller.process.command import parser as controller_parser
from timberhand.service_status.status import SERVICE_PAGE
from timberhand.why.stops import SERVICE_STOPS

DEPLOY = Path(__file__).parents[2] / "deploy"
UNITS = sorted((DEPLOY / "units").glob("*.service"))
PROCESSES = [unit for unit in UNITS if "@" not in unit.name]
CONF = dict(
    line.split("=", 1)
    for line in (DEPLOY / "timberhand.conf").read_text().splitlines()
    if not line.startswith("#") and line
)
EXPOSURE = {"controller": 1.3, "guard": 1.0, "autonomy": 0.9, "recorder": 1.1, "console": 0.9, "plc": 1.4, "can@": 1.1}
"""Exposure of each unit by systemd-analyze, of 10; at most 1.5."""
EPHEMERAL = 32768
"""First ephemeral port of the kernel (ip_local_port_range)."""
INTENDED = {"RestrictRealtime", "RestrictAddressFamilies", "IPAddressAllow", "PrivateUsers", "CapabilityBoundingSet"}
"""Hardening settings that may differ between units: FIFO, CAN, network, and interface configuration."""

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing (apt-get install systemd)"
)


def short(unit: Path) -> str:
    """The name without what all names have."""
    return unit.stem.removeprefix("timberhand-")


def setting(unit: Path, name: str) -> list[str]:
    """Every value of a setting."""
    return re.findall(rf"^{name}=(.*)$", unit.read_text(), re.MULTILINE)


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
                found.append(re.sub(r"\$\{(\w+)}", lambda m: conf[m[1]], word))
        return found
    text = script[1].replace("$$", "$").replace("%%", "%")
    folders = {"RUNTIME_DIRECTORY": "/run/timberhand", "STATE_DIRECTORY": "/var/lib/timberhand", "PATH": os.defpath}
    done = subprocess.run(
        ["sh", "-uc", f"printf '%s\\n' {text}"], env=conf | folders, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def test_every_process_has_its_unit() -> None:
    assert {short(unit) for unit in UNITS} == set(EXPOSURE)


@needs_systemd
@pytest.mark.parametrize("unit", UNITS, ids=lambda u: u.stem)
def test_the_security_exposure_of_every_unit_is_small(unit: Path) -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--no-pager", str(unit)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    level = re.search(r"Overall exposure level for .*: ([\d.]+)", done.stdout)
    assert level, done.stderr
    assert float(level[1]) <= EXPOSURE[short(unit)] <= 1.5, done.stdout


@needs_systemd
def test_systemd_analyze_reports_no_fault(tmp_path: Path) -> None:
    for unit in (DEPLOY / "units").iterdir():
        text = unit.read_text().replace("/opt/timberhand/bin/python", sys.executable)
        (tmp_path / unit.name).write_text(text.replace("/usr/lib/timberhand/can-up", str(DEPLOY / "system/can-up")))
    done = subprocess.run(
        ["systemd-analyze", "verify", *map(str, sorted(tmp_path.iterdir()))],
        capture_output=True,
        text=True,
        check=False,
    )
    assert [line for line in done.stderr.splitlines() if "timberhand" in line] == []
    assert done.returncode == 0


def test_the_hardening_is_the_same_everywhere() -> None:
    bodies = []
    for unit in UNITS:
        body = unit.read_text().split("# No more rights than needed.\n")[1].split("\n\n")[0].splitlines()
        settings = {line for line in body if not line.startswith("#")}
        bodies.append({line for line in settings if line.split("=")[0] not in {*INTENDED, "AmbientCapabilities"}})
    common = set.intersection(*bodies)
    assert len(common) >= 24
    for unit, body in zip(UNITS, bodies, strict=True):
        more = set()
        if setting(unit, "CPUSchedulingPolicy") == ["fifo"]:
            more.add("SystemCallFilter=sched_setscheduler sched_setaffinity mlockall")
        if short(unit) == "controller":
            more |= {"BindPaths=-/dev/cpu_dma_latency", "DeviceAllow=/dev/cpu_dma_latency rw"}
        assert body - common == more, unit.name


def test_only_the_control_processes_are_real_time_and_the_guard_has_the_highest_priority() -> None:
    priority = {unit.stem: setting(unit, "CPUSchedulingPriority") for unit in UNITS}
    timed = {name: int(value[0]) for name, value in priority.items() if value}
    assert timed == {"timberhand-controller": 80, "timberhand-guard": 85, "timberhand-plc": 70}
    for unit in (u for u in UNITS if u.stem in timed):
        assert setting(unit, "Type") == ["notify"]
        assert setting(unit, "WatchdogSec") == ["1"]
        assert setting(unit, "Restart") == ["on-failure"]
        assert setting(unit, "RestartPreventExitStatus") == ["2 3"]
        assert setting(unit, "LimitRTPRIO") == [str(timed[unit.stem])]
        assert setting(unit, "LimitMEMLOCK") == ["infinity"]


def test_every_process_has_its_own_user_created_by_the_installation() -> None:
    users = [setting(unit, "User")[0] for unit in PROCESSES]
    made = set(re.findall(r"^u (\S+)", (DEPLOY / "system/sysusers.conf").read_text(), re.MULTILINE))
    assert len(set(users)) == len(users)
    assert set(users) == made
    for unit in UNITS:
        assert setting(unit, "User") == setting(unit, "Group")


def test_settings_and_units_match() -> None:
    used = set()
    for text in [unit.read_text() for unit in UNITS] + [(DEPLOY / "system/can-up").read_text()]:
        used |= set(re.findall(r"\$\{?([A-Z]+(?:_[A-Z]+)*)\b", text))
    assert used - set(CONF) <= {"STATE_DIRECTORY", "RUNTIME_DIRECTORY", "CAN_WAIT_S"} | {"CAN_WAIT"}
    assert set(CONF) <= used
    ports = [value for name, value in CONF.items() if name.endswith("_PORT")]
    assert len(set(ports)) == len(ports)
    assert all(int(port) < EPHEMERAL for port in ports)


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
    for name in ("controller", "guard", "recorder"):
        unit = DEPLOY / f"units/timberhand-{name}.service"
        assert [word for word in words(unit) if "mach0" in word] == []
        given = words(unit, MACHINE_BUS="socketcan:mach0")
        assert given[given.index("mach0=socketcan:mach0") - 1] == "--bus"


def test_every_option_that_the_settings_explain_exists() -> None:
    """And the page lies where everyone looks for it."""
    text = (DEPLOY / "timberhand.conf").read_text()
    text = text.split("# How the controller waits")[1]
    explained = re.findall(r"^#   (--\S+)(?: (\d+))?", text, re.MULTILINE)
    assert len(explained) == 4
    unit = DEPLOY / "units/timberhand-controller.service"
    options = " ".join(" ".join(pair) for pair in explained)
    controller_parser().parse_args(words(unit, CONTROLLER_OPTIONS=options)[3:])
    for name in ("recorder", "console"):
        given = words(DEPLOY / f"units/timberhand-{name}.service")
        assert given[given.index("--timing") + 1] == str(SERVICE_PAGE)


def test_the_stops_of_the_service_lie_where_everyone_looks_for_them() -> None:
    given = words(DEPLOY / "units/timberhand-recorder.service")
    assert given[given.index("--stops") + 1] == str(SERVICE_STOPS) and "--journal" in given


def test_the_target_starts_and_stops_every_process() -> None:
    for unit in PROCESSES:
        assert setting(unit, "WantedBy") == ["timberhand.target"], unit.name
        assert setting(unit, "PartOf") == ["timberhand.target"], unit.name
