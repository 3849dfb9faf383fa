"""Checks the values of ``timberhand.conf`` against each other, the machine's profile and its envelope.

Reads the profile and the envelope that the settings name; everything else is pure.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from controller.guard.__main__ import profile_path
from controller.guard.envelope import read_envelope
from controller.guard.layout import GuardConfigError
from host.release import installed
from host.release.installed import PROGRAM
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import Profile
from timberhand.configuration.settings_file import Problem, Setting, parse, read, unknown

UDP_PORTS: Final = range(24700, 24800)
"""What the units let the services open."""
PAGE_PORTS: Final = range(8000, 9000)
BIT_RATES: Final = (10_000, 1_000_000)
_BUS: Final = re.compile(r"(python-can:)?[a-z][a-z0-9_]*:\S+")
_PLACE: Final = re.compile(r"[\w.:\[\]-]+:\d+")


def problems_of(text: str, shipped: str) -> list[Problem]:
    """List everything that is wrong with a settings file, in the order of its lines."""
    problems: list[Problem] = []
    settings = parse(text, problems)
    problems += unknown(settings, parse(shipped, []))
    problems += _ports(settings)
    problems += _buses(settings)
    profile_setting = settings.get("PROFILE")
    if profile_setting is not None:
        problems += _machine(settings, profile_setting)
    return sorted(problems, key=lambda problem: problem.line)


def signature_problems(settings: Path, signer: Path) -> Iterator[Problem]:
    """Report what of the program and the machine's files is not as it was signed."""
    profile = parse(read(settings), []).get("PROFILE")
    path = profile_path(profile.value) if profile is not None else PROGRAM
    for problem in installed.problems(signer, path):
        yield Problem(0, f"{problem.sentence} [{problem.code}]")


def _number(settings: dict[str, Setting], name: str) -> int | None:
    setting = settings.get(name)
    return int(setting.value) if setting is not None and setting.value.isdecimal() else None


def _ports(settings: dict[str, Setting]) -> Iterator[Problem]:
    used: dict[int, str] = {}
    for name, setting in settings.items():
        if not name.endswith("_PORT"):
            continue
        allowed = PAGE_PORTS if name == "CONSOLE_PORT" else UDP_PORTS
        port = _number(settings, name)
        if port is None or port not in allowed:
            yield Problem(
                setting.line, f"{name}={setting.value}: the services may open ports {allowed[0]} to {allowed[-1]} here"
            )
        elif port in used:
            yield Problem(setting.line, f"{name} and {used[port]} are both {port}; give each a port of its own")
        else:
            used[port] = name
    scene = settings.get("SCENE")
    if scene is not None and not _PLACE.fullmatch(scene.value):
        yield Problem(scene.line, f"SCENE={scene.value}: write HOST:PORT, as in 127.0.0.1:24710")


def _buses(settings: dict[str, Setting]) -> Iterator[Problem]:
    for bus_name in ("CRANE", "MACHINE"):
        bus = settings.get(f"{bus_name}_BUS")
        if bus is not None and bus.value and not _BUS.fullmatch(bus.value):
            yield Problem(bus.line, f"{bus_name}_BUS={bus.value} is no address; write socketcan:INTERFACE")
        rate = settings.get(f"{bus_name}_BITRATE")
        value = _number(settings, f"{bus_name}_BITRATE")
        if rate is not None and (value is None or not BIT_RATES[0] <= value <= BIT_RATES[1]):
            low, high = BIT_RATES
            yield Problem(rate.line, f"{bus_name}_BITRATE={rate.value}: classic CAN has {low} to {high} bit/s")
    crane, machine = settings.get("CRANE_BUS"), settings.get("MACHINE_BUS")
    if crane is not None and not crane.value:
        yield Problem(crane.line, "CRANE_BUS is empty: every machine has a crane bus, as in socketcan:crane0")
    if crane is not None and machine is not None and crane.value and crane.value == machine.value:
        yield Problem(machine.line, f"CRANE_BUS and MACHINE_BUS are both {crane.value}: they are two buses")


def _machine(settings: dict[str, Setting], named: Setting) -> Iterator[Problem]:
    try:
        profile = load_profile(named.value)
    except ProfileError as error:
        yield Problem(named.line, f"PROFILE={named.value}: {str(error).splitlines()[0]}")
        return
    try:
        read_envelope(Path(profile_path(named.value)))
    except GuardConfigError as error:
        yield Problem(named.line, f"PROFILE={named.value}: the guard would not start: {error}")
    yield from _fit(settings, profile)


def _fit(settings: dict[str, Setting], profile: Profile) -> Iterator[Problem]:
    """Check whether buses, camera and PLC are those of the machine."""
    bus = settings.get("MACHINE_BUS")
    if bus is not None and profile.carrier is not None and not bus.value:
        yield Problem(bus.line, f"{profile.name} drives and needs MACHINE_BUS, as in socketcan:mach0")
    if bus is not None and profile.carrier is None and bus.value:
        yield Problem(bus.line, f"{profile.name} stands and has no machine bus; leave MACHINE_BUS empty")
    camera = settings.get("CAMERA")
    if camera is not None and camera.value and camera.value not in profile.cameras:
        known = ", ".join(profile.cameras) or "none"
        yield Problem(camera.line, f"{profile.name} has no camera {camera.value}; it has: {known}")
    plc = settings.get("PLC")
    if plc is not None and plc.value and profile.plc is None:
        yield Problem(plc.line, f"{profile.name} has no [plc] table (docs/how-to/plc.md); add it, or leave PLC empty")
    if plc is not None and not plc.value and profile.plc is not None:
        yield Problem(plc.line, f"{profile.name} is driven through a PLC; write its address, as in --modbus HOST:502")
