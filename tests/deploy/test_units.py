"""The unit files: checked by systemd's tools, and compared with the settings and the programs that they start."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.deploy.unit_files import CONF, DEPLOY, EXPOSURE, UNITS, setting, short

PROCESSES = [unit for unit in UNITS if "@" not in unit.name]
EPHEMERAL = 32768
"""First ephemeral port of the kernel (ip_local_port_range)."""
INTENDED = {
    "SocketBindAllow",
    "RestrictRealtime",
    "RestrictAddressFamilies",
    "IPAddressAllow",
    "PrivateUsers",
    "CapabilityBoundingSet",
    "MemoryDenyWriteExecute",
    "PrivateDevices",
    "ProcSubset",
}
"""Hardening settings that may differ between units: FIFO, CAN, network, interface configuration, compiled
networks, and cameras."""


def test_every_process_has_its_unit() -> None:
    assert {short(unit) for unit in UNITS} == set(EXPOSURE)


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
        if short(unit) == "perception":
            devices = ("usb_device", "video4linux", "hidraw", "nvidia*")
            more |= {f"DeviceAllow=char-{device} rw" for device in devices}
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


def test_only_what_runs_networks_makes_machine_code_and_sees_the_processor_and_only_the_camera_sees_devices() -> None:
    loose = {short(unit) for unit in UNITS if setting(unit, "MemoryDenyWriteExecute") == ["no"]}
    sees_cpuinfo = {short(unit) for unit in UNITS if setting(unit, "ProcSubset") != ["pid"]}
    assert loose == sees_cpuinfo == {"perception", "autonomy"}
    assert {short(unit) for unit in UNITS if setting(unit, "PrivateDevices") == ["no"]} == {"perception"}
    unit = DEPLOY / "units/timberhand-perception.service"
    assert setting(unit, "Type") == ["notify"] and int(setting(unit, "WatchdogSec")[0]) <= 10


def test_every_process_has_its_own_user_created_by_the_installation() -> None:
    users = [setting(unit, "User")[0] for unit in UNITS]
    made = set(re.findall(r'^u (\S+) - "[^"]+" \S+ -$', (DEPLOY / "system/sysusers.conf").read_text(), re.MULTILINE))
    assert len(set(users)) == len(users)
    assert set(users) == made | {"root"}
    assert setting(DEPLOY / "units/timberhand-update.service", "User") == ["root"], "nobody else changes the release"
    for unit in UNITS:
        assert setting(unit, "User") == setting(unit, "Group")


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


def test_the_ports_of_the_settings_may_be_opened_by_the_services_that_use_them() -> None:
    ranges = {"udp": range(24700, 24800), "tcp": range(8000, 9000)}
    for name, value in CONF.items():
        if name.endswith("_PORT"):
            assert int(value) in ranges["tcp" if name == "CONSOLE_PORT" else "udp"], name
    users = {name: {"udp"} for name in ("controller", "perception", "autonomy", "recorder")} | {
        "console": {"udp", "tcp"}
    }
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
