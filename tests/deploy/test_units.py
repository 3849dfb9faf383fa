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
from console.__main__ import command_line as console_command_line
from controller.plc.__main__ import parser as plc_parser
from controller.process.command import parser as controller_parser
from host.release.gate import LIMIT_NS
from host.release.services import RESUME
from host.release.trees import TRIAL
from host.release.updater import PLACE
from timberhand.cli import app
from timberhand.service_status.status import NAMES, SERVICE_PAGE
from timberhand.why.stops import SERVICE_STOPS

DEPLOY = Path(__file__).parents[2] / "deploy"
UNITS = sorted((DEPLOY / "units").glob("*.service"))
PROCESSES = [unit for unit in UNITS if "@" not in unit.name]
CONF = dict(
    line.split("=", 1)
    for line in (DEPLOY / "timberhand.conf").read_text().splitlines()
    if not line.startswith("#") and line
)
EXPOSURE = {
    "controller": 1.3, "guard": 1.0, "autonomy": 0.9, "recorder": 1.1, "console": 1.1, "plc": 1.4, "can@": 1.1,
    "update": 1.2,
}  # fmt: skip
"""Exposure of each unit by systemd-analyze, of 10; at most 1.5."""
CREDENTIALS = "/run/credentials"
EPHEMERAL = 32768
"""First ephemeral port of the kernel (ip_local_port_range)."""
INTENDED = {
    "SocketBindAllow",
    "RestrictRealtime",
    "RestrictAddressFamilies",
    "IPAddressAllow",
    "PrivateUsers",
    "CapabilityBoundingSet",
}
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
                found.append(re.sub(r"\$\{(\w+)}", lambda m: conf[m[1]], word).replace("%d", CREDENTIALS))
        return found
    text = script[1].replace("$$", "$").replace("%d", CREDENTIALS).replace("%%", "%")
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
        if short(unit) == "update":
            more.add("ReadWritePaths=/opt/timberhand")
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
    users = [setting(unit, "User")[0] for unit in UNITS]
    made = set(re.findall(r"^u (\S+)", (DEPLOY / "system/sysusers.conf").read_text(), re.MULTILINE))
    assert len(set(users)) == len(users)
    assert set(users) == made | {"root"}
    assert setting(DEPLOY / "units/timberhand-update.service", "User") == ["root"], "nobody else changes the release"
    for unit in UNITS:
        assert setting(unit, "User") == setting(unit, "Group")


def test_an_interrupted_update_is_finished_at_the_start_and_only_then() -> None:
    unit = DEPLOY / "units/timberhand-update.service"
    assert setting(unit, "ConditionPathIsSymbolicLink") == [str(PLACE / TRIAL)]
    given = words(unit)
    assert given == ["-P", "-m", "timberhand", "service", "resume"]
    service = get_command(app).commands["service"]  # type: ignore[attr-defined]
    assert "resume" in service.commands
    assert float(setting(unit, "TimeoutStartSec")[0]) > 2 * LIMIT_NS * 1e-9
    assert unit.name == RESUME and unit.name.removesuffix(".service").removeprefix("timberhand-") in NAMES


@pytest.mark.parametrize("unit", [unit for unit in UNITS if short(unit) != "update"], ids=lambda u: u.stem)
def test_a_setting_that_a_computer_lacks_is_as_the_release_ships_it(unit: Path) -> None:
    files = ["/opt/timberhand/current/deploy/timberhand.conf", "/etc/timberhand/timberhand.conf"]
    assert setting(unit, "EnvironmentFile") == files, "the later file wins"


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
    assert {port for _, port in planner.tell} == reports - {planner.report_port}, "page and recorder get its missions"
    page = console_command_line().parse_args(words(unit / "timberhand-console.service")[3:])
    assert (page.bus, page.report_port in reports) == (["crane0=socketcan:crane0"], True)


def test_page_and_planner_share_the_folder_of_missions_as_the_settings_show() -> None:
    """The page owns it, the planner is in its group and may read what the page saves, and nobody else sees it."""
    unit, text = DEPLOY / "units", (DEPLOY / "timberhand.conf").read_text()
    shown = {name: re.findall(rf"^#   {name}=(--(?:missions|planner) .*)$", text, re.MULTILINE)[0]
             for name in ("AUTONOMY_OPTIONS", "CONSOLE_OPTIONS")}  # fmt: skip
    planner = autonomy_arguments(words(unit / "timberhand-autonomy.service", **shown)[3:])
    page = console_command_line().parse_args(words(unit / "timberhand-console.service", **shown)[3:])
    assert page.missions == planner.missions and page.planner == f"127.0.0.1:{planner.order_port}"
    assert 24700 <= planner.order_port <= 24799 and str(planner.order_port) not in CONF.values()
    console, users = unit / "timberhand-console.service", [setting(unit / f"timberhand-{name}.service", "User")[0]
                                                           for name in ("console", "autonomy")]  # fmt: skip
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


def test_the_target_starts_and_stops_every_process() -> None:
    for unit in PROCESSES:
        assert setting(unit, "WantedBy") == ["timberhand.target"], unit.name
        assert setting(unit, "PartOf") == ["timberhand.target"], unit.name


@pytest.mark.parametrize("unit", UNITS, ids=lambda u: u.stem)
def test_a_unit_may_use_no_more_than_its_share_and_runs_nothing_but_installed_programs(unit: Path) -> None:
    assert setting(unit, "Slice") == ["timberhand.slice"]
    assert 0 < int(setting(unit, "TasksMax")[0]) <= 128
    assert setting(unit, "LimitCORE") == ["0"]
    assert setting(unit, "NoExecPaths") == ["/"] and setting(unit, "ExecPaths") == ["/usr /opt"]
    assert setting(unit, "SocketBindDeny") == ["any"]
    timed = setting(unit, "CPUSchedulingPolicy") == ["fifo"]
    assert setting(unit, "LimitRTTIME") == (["15s"] if timed else [])


def test_the_control_processes_keep_their_memory_and_the_slice_has_it_to_give() -> None:
    kept = {unit.stem: setting(unit, "MemoryMin") for unit in UNITS if setting(unit, "MemoryMin")}
    assert kept == {"timberhand-controller": ["128M"], "timberhand-guard": ["128M"]}
    assert setting(DEPLOY / "units/timberhand.slice", "MemoryMin") == ["256M"]


@pytest.mark.parametrize("name", ["controller", "autonomy", "console", "recorder"])
def test_the_key_comes_as_a_credential_and_nobody_names_the_file(name: str) -> None:
    unit = DEPLOY / f"units/timberhand-{name}.service"
    assert setting(unit, "LoadCredential") == ["key:/etc/timberhand/key"]
    given = words(unit)
    assert given[given.index("--key-file") + 1] == f"{CREDENTIALS}/key"


def test_the_ports_of_the_settings_may_be_opened_by_the_services_that_use_them() -> None:
    ranges = {"udp": range(24700, 24800), "tcp": range(8000, 9000)}
    for name, value in CONF.items():
        if name.endswith("_PORT"):
            assert int(value) in ranges["tcp" if name == "CONSOLE_PORT" else "udp"], name
    users = {"controller": {"udp"}, "autonomy": {"udp"}, "recorder": {"udp"}, "console": {"udp", "tcp"}}
    for unit in UNITS:
        allowed = {
            f"ipv4:{kind}:{ports[0]}-{ports[-1]}"
            for kind, ports in ranges.items()
            if kind in users.get(short(unit), ())
        }
        assert set(setting(unit, "SocketBindAllow")) == allowed, unit.name


@pytest.mark.parametrize("unit", UNITS, ids=lambda u: u.stem)
def test_a_failure_of_any_service_leaves_a_record(unit: Path) -> None:
    script = "/opt/timberhand/current/deploy/system/service-ended"
    assert setting(unit, "ExecStopPost") == [f"+/bin/sh {script} %n"]


@pytest.mark.parametrize("unit", UNITS, ids=lambda u: u.stem)
def test_no_unit_reaches_another_computer_and_none_loses_its_buses(unit: Path) -> None:
    """A network namespace of its own would hide the CAN interfaces, and the loopback of the others."""
    assert setting(unit, "IPAddressDeny") == ["any"]
    assert setting(unit, "IPAddressAllow") in ([], ["localhost"])
    assert not setting(unit, "PrivateNetwork") and not setting(unit, "JoinsNamespaceOf")


def test_only_a_plc_that_was_named_is_reached() -> None:
    assert setting(DEPLOY / "units/timberhand-plc.service", "IPAddressAllow") == ["localhost"]
