"""Boots the guest and collects its messages.  Failure: ``LabError``.

The guest writes JSON lines to its first console: ``{"event": ...}`` for every step, ``{"result": {...}}`` at the end.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import platform
import select
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from host.release import bundle
from host.release.signature import make_keys
from host.vcan_lab import keeper, uml
from host.vcan_lab.spec import VIRTUAL_START_NS, LabError

ROOT: Final = Path(__file__).resolve().parents[2]
CHECKOUT: Final = ROOT / "pyproject.toml"
MEM_MB: Final = 4096
"""Memory for the plant, the installed program on the overlay, and systemd; the host provides only touched pages."""
PARTS: Final = ("services", "loading")
"""What each guest does: services and buses end in every way; a log is loaded, in simulated time."""
END_S: Final = 10.0
WARM_UP_S: Final = 300.0
LEFT_OUT: Final = shutil.ignore_patterns(".*", "runs", "build", "dist", "__pycache__", "*.egg-info")

WARM_UP: Final = """\
import host.service_lab.guest
from machine.loading.profile_file import load_profile
from sim.plant import Plant
plant = Plant(load_profile("palms_471"))
for now_ms in range(1000, 1100, 5):
    plant.step(now_ms * 1_000_000, [])
"""
"""Compiles the code for the guest; inside it would take long."""

CHECK_SERVICE: Final = """\
[Unit]
Description=timberhand service lab
After=basic.target
[Service]
Type=exec
Environment=PYTHONDONTWRITEBYTECODE=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
Environment=PYTHONPATH={program}:{packages}
WorkingDirectory=/
ExecStart={python} -m host.service_lab.guest {order}
StandardOutput=tty
StandardError=inherit
TTYPath=/dev/tty1
LimitRTPRIO=99
[Install]
WantedBy=multi-user.target
"""


def missing() -> str | None:
    """Say why this computer cannot run the lab; None when it can."""
    if platform.machine() != "x86_64":
        return f"user-mode Linux runs on x86_64 only, this is {platform.machine()}"
    if uml.find(uml.user_cache()) is None:
        return uml.MISSING
    if not Path("/lib/systemd/systemd").exists():
        return "systemd is missing: apt-get install systemd"
    if not Path("/lib/systemd/systemd-udevd").exists():
        return "udev is missing: apt-get install udev"
    if os.geteuid() != 0:
        return "the guest runs on this computer's files, so the lab requires root"
    python = python_for_services()
    probe = [python, "-c", "import ensurepip, venv"]
    if not Path(python).exists() or subprocess.run(probe, capture_output=True, check=False).returncode:
        return f"{python} is missing or cannot create virtual environments: apt-get install python3-venv"
    return None


def python_for_services() -> str:
    """Return the system's Python of this version; services cannot use one in a home directory."""
    return f"/usr/bin/python{sys.version_info.major}.{sys.version_info.minor}"


def build_wheel(folder: Path) -> Path:
    """Build a wheel of this checkout in ``folder``; the checkout is not changed."""
    if not CHECKOUT.is_file():
        raise LabError("service-lab.no-checkout", f"{ROOT} is not a checkout to build a wheel from; use --wheel")
    source = folder / "source"
    shutil.copytree(ROOT, source, ignore=LEFT_OUT)
    made = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", *_build_options(), "-w", folder, source],
        capture_output=True,
        text=True,
        check=False,
    )
    if made.returncode:
        reason = (made.stderr.strip().splitlines() or ["no message"])[-1]
        raise LabError("service-lab.wheel-build", f"the wheel cannot be built: {reason}")
    return next(folder.glob("timberhand-*.whl"))


def _build_options() -> list[str]:
    """Build without a network when this environment has the build tool."""
    version = importlib.metadata.version("setuptools")
    return ["--no-build-isolation"] if int(version.split(".")[0]) >= 77 else []


def run(
    wheel: Path | None, timeout_s: float, show_step: Callable[[str], None], parts: Sequence[str] = PARTS
) -> dict[str, Any]:
    """Run a guest for each part and return their result; ``show_step`` gets a line for every step.

    Everything in the guest runs from the wheel, including the test itself and the emulated machine; the checkout is
    hidden from it.

    Raises:
        LabError: the lab cannot run, or the guest gives no result.
    """
    if fault := missing():
        raise LabError("service-lab.unavailable", f"the service lab cannot run here: {fault}")
    with tempfile.TemporaryDirectory(prefix="timberhand-service-") as name:
        folder = Path(name)
        wheel = wheel.resolve() if wheel else build_wheel(folder)
        program = folder / "program"
        zipfile.ZipFile(wheel).extractall(program)
        packages, python = f"/opt/environment/{_packages().relative_to(sys.prefix)}", python_for_services()
        _warm_up(python, f"{program}:{_packages()}")
        order = {"wheel": str(wheel), "python": python, "environment": "/opt/environment", **_bundles(wheel, folder)}
        check = CHECK_SERVICE.format(program=program, packages=packages, python=python, order=folder / "order.json")
        (folder / "check.service").write_text(check)
        settings = [
            f"LAB={folder}",
            f"ENVIRONMENT={Path(sys.prefix).resolve()}",
            *([f"CHECKOUT={ROOT}"] if CHECKOUT.is_file() else []),
        ]
        init = program / "host" / "service_lab" / "init.sh"
        init.chmod(0o755)
        result: dict[str, Any] = {"failed": [], "figures": {}, "trials": []}
        for part in parts:
            (folder / "order.json").write_text(json.dumps(order | {"steps": part}))
            part_result = _boot([f"init={init}", *settings], timeout_s, show_step)
            joined = {name: result[name] + part_result[name] for name in ("failed", "trials")}
            result |= part_result | joined | {"figures": result["figures"] | part_result["figures"]}
        return result


def _bundles(wheel: Path, folder: Path) -> dict[str, str]:
    """Make signed bundles for the updates: a release that works, and one whose controller ends at once."""
    private, public = make_keys(folder / "keys")
    made = {"signer": str(public)}
    changes = {"bundle": {}, "broken": {"controller/__main__.py": b"raise SystemExit(1)\n"}}
    for name, change in changes.items():
        other = folder / name / wheel.name
        other.parent.mkdir()
        with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(other, "w", zipfile.ZIP_DEFLATED) as target:
            for entry in source.infolist():
                target.writestr(entry, change.get(entry.filename, source.read(entry)))
            target.writestr("host/service_lab/variant.txt", name)
        made[name] = str(bundle.make(other, private, folder, None, None))
    return made


def _packages() -> Path:
    """Return the folder of this environment's packages."""
    return Path(sysconfig.get_path("purelib"))


def _warm_up(python: str, path: str) -> None:
    environment = {"PATH": os.defpath, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    try:
        subprocess.run(
            [python, "-c", WARM_UP],
            env=environment,
            cwd="/",
            capture_output=True,
            text=True,
            check=True,
            timeout=WARM_UP_S,
        )
    except subprocess.SubprocessError as error:
        reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines()[-1]
        raise LabError("service-lab.wheel-broken", f"the program in the wheel does not run: {reason}") from error


def _boot(settings: list[str], timeout_s: float, show_step: Callable[[str], None]) -> dict[str, Any]:
    kernel = uml.find(uml.user_cache())
    assert kernel
    messages, guest_end = os.pipe()
    log = os.memfd_create("kernel log")
    arguments = [
        f"mem={MEM_MB}M",
        "root=none",
        "rootfstype=hostfs",
        "rootflags=/",
        "rw",
        "con=null",
        "con0=null,fd:1",
        "ssl=null",
        f"con1=null,fd:{guest_end}",
        "uml_dir=/proc/",
        "quiet",
        "panic=1",
        "noreboot",
        "time-travel=inf-cpu",
        f"time-travel-start={VIRTUAL_START_NS}",
        *settings,
    ]
    guest = subprocess.Popen(
        [sys.executable, "-ISB", keeper.__file__, kernel, *arguments],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        env={"PATH": os.defpath},
        cwd="/",
        start_new_session=True,
        pass_fds=[guest_end],
    )
    os.close(guest_end)
    try:
        result = _receive(messages, time.monotonic() + timeout_s, show_step)
    finally:
        assert guest.stdin
        with contextlib.suppress(subprocess.TimeoutExpired):
            guest.wait(0 if sys.exc_info()[0] else END_S)
        guest.stdin.close()  # the keeper ends with it
        guest.wait()
        os.close(messages)
    if result is None:
        lines = os.pread(log, 1 << 20, 0).decode(errors="replace").strip().splitlines()[-12:]
        raise LabError("service-lab.no-result", "\n  ".join(["the guest gave no result", *lines]))
    os.close(log)
    return result


def _receive(messages: int, deadline_s: float, show_step: Callable[[str], None]) -> dict[str, Any] | None:
    """Receive the result of the guest; None when it ends or the deadline passes first."""
    rest = b""
    while (left_s := deadline_s - time.monotonic()) > 0 and select.select([messages], [], [], left_s)[0]:
        data = os.read(messages, 65536)
        if not data:
            return None
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").strip()
            message = None
            with contextlib.suppress(json.JSONDecodeError):
                message = json.loads(text)
            if not isinstance(message, dict):
                show_step(text)
            elif "result" in message:
                result: dict[str, Any] = message["result"]
                return result
            else:
                show_step(f"{message['at_s']:7.1f} s  {message['event']}")
    return None
