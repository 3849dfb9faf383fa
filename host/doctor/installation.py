"""Checks the installation: Python, packages, the compiled tick, profiles, buses, camera, lab, places, ports, key.

Reads the running system.  Only what prevents every run is a FAULT: a missing package, a profile that does not load.
Packages and versions come from the metadata of the distribution.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement

from can_dbc.bus.factory import PYTHON_CAN, kernel_has_can
from can_dbc.messages.envelope import MIN_KEY_BYTES, SERVICE_KEY
from controller.guard.__main__ import profile_path
from host.doctor.finding import Finding, Severity, fine, row
from host.release import installed
from host.release.updater import SIGNER
from host.vcan_lab import uml
from host.vcan_lab.choose import choose, survey
from host.vcan_lab.spec import LabError, Request
from machine.loading.profile_file import ProfileError, load_profile, shipped_profiles

EXTRAS: Final = {
    "sim": "the simulated plant: `make demo`",
    "autonomy": "the planner",
    "console": "the operator's page",
    "tools": "plots and pictures",
}
"""The purpose of each optional group of packages."""
CONF: Final = Path("/etc/timberhand/timberhand.conf")
DATA: Final = Path("/var/lib/timberhand")
KEY_OWNER: Final = 0
MIN_FREE_MB: Final = 1000
"""Disk space for some hours of recording."""
ADVICE, CHANGE, FAULT = Severity.ADVICE, Severity.CHANGE, Severity.FAULT


def examine() -> tuple[Finding, ...]:
    """Return all findings, in the order in which to correct them."""
    before = (python(), *packages(), tick(), *profiles(), *buses(), *camera(), vcan_lab(), kernel_of_lab())
    return (*before, *places(), ports(), *key(), *signed())


def python() -> Finding:
    """Check the interpreter; pip refuses versions that are too old, and pybullet has no wheels for the newest."""
    version = sys.version.split()[0]
    return row(
        "python",
        f"Python {version} in {sys.prefix}" if sys.version_info < (3, 12) else "",
        ADVICE,
        f"Python {version} has no pybullet",
        "the simulated plant",
        "make setup PYTHON=python3.11",
    )


def packages() -> Iterator[Finding]:
    """Check whether every required package is installed in a suitable version."""
    gain, mend = "a working program", "make setup"
    try:
        requirements = [Requirement(text) for text in metadata.requires("timberhand") or ()]
    except metadata.PackageNotFoundError:
        yield row("packages", "", FAULT, "timberhand itself is not installed", gain, mend)
        return
    base = [need for need in requirements if need.marker is None or need.marker.evaluate({"extra": ""})]
    lacking = [fault for need in base if (fault := _missing(need))]
    good = (
        ""
        if lacking
        else f"timberhand {metadata.version('timberhand')}; all {len(base)} required packages are installed"
    )
    yield row("packages", good, FAULT, f"missing: {', '.join(lacking)}", gain, mend)
    for extra, purpose in EXTRAS.items():
        needs = [n for n in requirements if n.marker and n.marker.evaluate({"extra": extra}) and n not in base]
        if faults := [fault for need in needs if (fault := _missing(need))]:
            command = f"{sys.executable} -m pip install 'timberhand[{extra}]'"
            yield Finding(f"packages, {extra}", ADVICE, f"missing: {', '.join(faults)}", purpose, (command,))


def _missing(need: Requirement) -> str:
    try:
        installed_version = metadata.version(need.name)
    except metadata.PackageNotFoundError:
        return need.name
    return (
        ""
        if need.specifier.contains(installed_version, prereleases=True)
        else f"{need.name} {need.specifier} (is {installed_version})"
    )


def tick() -> Finding:
    """Check whether the controller would run a compiled tick, in a process of its own as `python -m controller`."""
    program = "from runtime.compiled import activate; found = activate(); print(found, found.reason, sep='|')"
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout.strip()
    running, _, reason = answer.partition("|")
    gain, wrong = "less than half the time for every tick", f"runs on the interpreter: {reason or 'unknown'}"
    return row("tick", running if running.startswith("compiled") else "", ADVICE, wrong, gain, "timberhand compile")


def profiles() -> Iterator[Finding]:
    """Check the shipped profiles, and the one in the settings."""
    names = [*shipped_profiles()]
    if (chosen := _settings().get("PROFILE")) and chosen not in names:
        names.append(chosen)
    for name in names:
        try:
            load_profile(name)
        except ProfileError as error:
            command = "git status machine" if name in shipped_profiles() else f"sudo nano {CONF}  # PROFILE"
            yield Finding("profile", FAULT, str(error), "the controller starts", (command,))
        else:
            yield fine("profile", f"{name} loads" + (", chosen in the settings" if name == chosen else ""))


def buses() -> Iterator[Finding]:
    """Check the buses that a controller can use."""
    interfaces, settings = [name for _, name in socket.if_nameindex()], _settings()
    if not kernel_has_can():
        wrong = "this kernel has no SocketCAN; the wire (a CAN bus in user space) works"
        command = "sudo modprobe can_raw  # if that fails: a kernel with CONFIG_CAN_RAW"
        yield Finding("buses", ADVICE, wrong, "a real machine", (command,))
    else:
        can_interfaces = [name for name in interfaces if _type_of(name) == "280"]  # ARPHRD_CAN, linux/if_arp.h
        yield fine("buses", f"SocketCAN: {', '.join(can_interfaces) or 'no interface yet'}; the wire")
    for setting in ("CRANE_BUS", "MACHINE_BUS"):
        address = settings.get(setting, "")
        backend, _, name = address.removeprefix(PYTHON_CAN).partition(":")
        if backend == "socketcan" and name not in interfaces:
            wrong = f"{setting}={address} in {CONF}, but there is no interface {name}"
            commands = (f"sudo nano {CONF}", "ip -brief link show type can")
            yield Finding("buses", CHANGE, wrong, "the controller service finds its bus", commands)


def camera() -> Iterator[Finding]:
    """Check the camera of the services, by the settings: whether what delivers its pictures is there."""
    settings = _settings()
    if "SCENE" not in settings:
        return
    gain, change = "the planner is told where logs lie", f"sudo nano {CONF}"
    name, frames = settings.get("CAMERA", ""), settings.get("CAMERA_FRAMES", "")
    if not frames:
        wrong = f"CAMERA_FRAMES is empty in {CONF}, so another program must detect logs at {settings['SCENE']}"
        yield Finding("camera", ADVICE, wrong, gain, (change,))
    elif frames == "zed" and importlib.util.find_spec("pyzed") is None:
        wrong = "CAMERA_FRAMES=zed, and the ZED SDK's Python API (pyzed) is not installed beside this program"
        yield Finding("camera", CHANGE, wrong, gain, ("python /usr/local/zed/get_python_api.py", change))
    elif "/" in frames and not Path(frames).is_dir():
        yield Finding("camera", CHANGE, f"CAMERA_FRAMES={frames} is no folder", gain, (f"ls -ld {frames}", change))
    else:
        yield fine("camera", f"{name or 'the first of the profile'}, with pictures from {frames}")


def vcan_lab() -> Finding:
    """Check whether the vcan lab works here."""
    request = Request((), "/", {}, os.getuid(), os.getgid(), (), 0o22)
    try:
        method = choose(survey(request))
    except LabError as reason:
        command = "sh deploy/debian_packages.sh"
        return Finding("vcan lab", ADVICE, str(reason), "SocketCAN for tests and demos", (command,))
    return fine("vcan lab", f"works ({method.kind})")


def kernel_of_lab() -> Finding:
    """Check the optional kernel with simulated time."""
    gain = "tests in simulated time: hil vcan --time-travel"
    return row("lab kernel", uml.find(uml.user_cache()) or "", ADVICE, "not built", gain, "make lab-kernel")


def places() -> Iterator[Finding]:
    """Check the directories of recordings and shared pages."""
    for folder, purpose in ((DATA, "the service's recordings"), (Path("runs"), "recordings of runs started here")):
        if folder is DATA and not folder.exists():
            continue  # not installed as a service
        existing_folder = next(p for p in (folder.absolute(), *folder.absolute().parents) if p.exists())
        free_mb = shutil.disk_usage(existing_folder).free >> 20
        if folder is not DATA and not os.access(existing_folder, os.W_OK):
            yield Finding(
                "disk", CHANGE, f"{existing_folder} cannot be written", purpose, (f"ls -ld {existing_folder}",)
            )
        elif free_mb < MIN_FREE_MB:
            yield Finding(
                "disk", CHANGE, f"{existing_folder} has {free_mb} MB free", purpose, (f"du -h -d 1 {existing_folder}",)
            )
        else:
            yield fine("disk", f"{existing_folder}: {free_mb >> 10} GB free for {purpose}")
    if not os.access(shm := "/dev/shm", os.W_OK):  # asked only  # nosec B108
        gain = "the controller's timing page"
        yield Finding("disk", CHANGE, f"{shm} cannot be written", gain, ("mount | grep shm",))


def ports() -> Finding:
    """Check the UDP ports of the settings, and the port of the page."""
    texts = {name: value for name, value in _settings().items() if name.endswith("_PORT")}
    for name, text in texts.items():
        if not re.fullmatch(r"[0-9]{1,5}", text) or not 0 < int(text) < 65536:
            wrong = f"{name}={text} is no port in {CONF}; a port is a number from 1 to 65535"
            return row("ports", "", CHANGE, wrong, "the services start", f"sudo nano {CONF}", "timberhand config check")
    required_ports = {name: int(text) for name, text in texts.items()} or {"CONSOLE_PORT": 8471}
    taken = {name: port for name, port in required_ports.items() if not _free(port, name == "CONSOLE_PORT")}
    taken_text = ", ".join(f"{name} {port}" for name, port in taken.items())
    return row(
        "ports",
        "" if taken else f"free: {', '.join(map(str, required_ports.values()))}",
        ADVICE,
        f"in use: {taken_text}; expected while the services run",
        "the processes find their ports",
        f"ss -lunpt | grep -E '{'|'.join(map(str, taken.values()))}'",
    )


def key() -> Iterator[Finding]:
    """Check the key of the installed services: there, secret, and long enough."""
    if not CONF.exists():
        return
    mend = ("sudo timberhand service install",)
    try:
        status = SERVICE_KEY.stat()
    except OSError:
        yield Finding("key", FAULT, f"{SERVICE_KEY} is missing", "the services start", mend)
        return
    if status.st_mode & 0o037 or status.st_uid != KEY_OWNER:
        command = (f"sudo chown root:timberhand-operator {SERVICE_KEY}", f"sudo chmod 0440 {SERVICE_KEY}")
        gain = "nobody but root and the operators can make a command"
        yield Finding("key", FAULT, f"others may read or change {SERVICE_KEY}", gain, command)
    elif status.st_size < MIN_KEY_BYTES:
        yield Finding("key", FAULT, f"{SERVICE_KEY} has {status.st_size} bytes", "the services start", mend)
    else:
        yield fine("key", f"{SERVICE_KEY}, for root and the operators")


def signed() -> Iterator[Finding]:
    """Check whether an installed release and the machine's own files are what was signed."""
    tree = installed.tree_of(installed.PROGRAM)
    if tree is None:
        return
    gain = "only what its maker signed runs here"
    if not SIGNER.is_file():
        command = f"sudo install -m 0644 signer.pem {SIGNER}"
        yield Finding("signature", ADVICE, f"no key of a signer in {SIGNER}", gain, (command,))
        return
    chosen = _settings().get("PROFILE")
    problems = list(installed.problems(SIGNER, profile_path(chosen) if chosen else installed.PROGRAM))
    for problem in problems:
        command = "sudo timberhand service update BUNDLE"
        yield Finding("signature", CHANGE, problem.sentence, gain, (command,))
    if not problems:
        yield fine("signature", f"the release {tree.name} and the machine's files are what was signed")


def _free(port: int, stream: bool) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM if stream else socket.SOCK_DGRAM) as trial:
        if stream:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def _settings() -> dict[str, str]:
    try:
        text = CONF.read_text()
    except OSError:
        return {}
    return dict(re.findall(r"^(\w+)=(.*?)[ \t]*$", text, re.MULTILINE))


def _type_of(interface: str) -> str:
    try:
        return Path(f"/sys/class/net/{interface}/type").read_text().strip()
    except OSError:
        return ""
