"""Boots the guest and collects what it says.  Failure: ``LabError`` with one sentence.

The guest writes JSON lines to its first console: ``{"event": ...}`` as it goes, ``{"result": {...}}`` at the end.
"""

from __future__ import annotations

import contextlib
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
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from host.vcan_lab import keeper, shim
from host.vcan_lab.spec import LabError
from host.vcan_lab.uml import KERNEL

ROOT: Final = Path(__file__).resolve().parents[2]
CHECKOUT: Final = ROOT / "pyproject.toml"
MEM_MB: Final = 1536
"""The plant with its compiled parts, the installed program on the overlay, and systemd; the host gives what is used."""
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
"""Compiles what the guest runs: in the guest it would take long, and while services are timed."""

CHECK_SERVICE: Final = """\
[Unit]
Description=the check
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
    """Why there is no lab on this machine, or None."""
    if platform.machine() != "x86_64":
        return f"user-mode Linux runs on x86_64 only, this is {platform.machine()}"
    if shutil.which(KERNEL) is None:
        return f"{KERNEL} is missing: apt-get install user-mode-linux"
    if not Path("/lib/systemd/systemd").exists():
        return "systemd is missing: apt-get install systemd"
    if not Path("/lib/systemd/systemd-udevd").exists():
        return "udev is missing: apt-get install udev"
    if os.geteuid() != 0:
        return "the guest's root is this machine's files: only root can be root on them"
    python = python_for_services()
    probe = [python, "-c", "import ensurepip, venv"]
    if not Path(python).exists() or subprocess.run(probe, capture_output=True, check=False).returncode:
        return f"{python} is missing or makes no virtual environments: apt-get install python3-venv"
    return None


def python_for_services() -> str:
    """The system's Python of this version: services see none in a home directory, nor its library."""
    return f"/usr/bin/python{sys.version_info.major}.{sys.version_info.minor}"


def build_wheel(folder: Path) -> Path:
    """A wheel of this checkout in ``folder``; the checkout stays as it is."""
    if not CHECKOUT.is_file():
        raise LabError(f"there is no checkout around {ROOT} to build a wheel from; name one with --wheel")
    source = folder / "source"
    shutil.copytree(ROOT, source, ignore=LEFT_OUT)
    made = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", *_build_options(), "-w", folder, source],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode:
        raise LabError(f"no wheel can be built: {(made.stderr.strip().splitlines() or ['no message'])[-1]}")
    return next(folder.glob("timberhand-*.whl"))


def _build_options() -> list[str]:
    """Without a network where this environment has the build tool itself."""
    import setuptools

    return ["--no-build-isolation"] if int(setuptools.__version__.split(".")[0]) >= 77 else []


def run(wheel: Path | None, timeout_s: float, tell: Callable[[str], None]) -> dict[str, Any]:
    """The guest's result; ``tell`` gets a line for every step.

    Whatever runs in the guest comes out of the wheel, the check itself and the emulated machine included; a checkout
    is hidden from it.
    """
    if fault := missing():
        raise LabError(f"no service lab here: {fault}")
    with tempfile.TemporaryDirectory(prefix="timberhand-service-") as name:
        folder = Path(name)
        wheel = wheel.resolve() if wheel else build_wheel(folder)
        program = folder / "program"
        zipfile.ZipFile(wheel).extractall(program)
        packages, python = f"/opt/environment/{_packages().relative_to(sys.prefix)}", python_for_services()
        _warm_up(python, f"{program}:{_packages()}")
        order = {"wheel": str(wheel), "python": python, "environment": "/opt/environment"}
        (folder / "order.json").write_text(json.dumps(order))
        check = CHECK_SERVICE.format(program=program, packages=packages, python=python, order=folder / "order.json")
        (folder / "check.service").write_text(check)
        settings = [
            f"LAB={folder}", f"ENVIRONMENT={Path(sys.prefix).resolve()}", f"PYTHON={python}",
            *([f"CHECKOUT={ROOT}"] if CHECKOUT.is_file() else []),
        ]  # fmt: skip
        init = program / "hil" / "service_lab" / "init.sh"
        init.chmod(0o755)
        return _boot(init, settings, timeout_s, tell)


def _packages() -> Path:
    """Where this environment keeps its packages."""
    return Path(sysconfig.get_path("purelib"))


def _warm_up(python: str, path: str) -> None:
    surroundings = {"PATH": os.defpath, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    try:
        subprocess.run(
            [python, "-c", WARM_UP], env=surroundings, cwd="/", capture_output=True, text=True, check=True,
            timeout=WARM_UP_S,
        )  # fmt: skip
    except subprocess.SubprocessError as error:
        said = getattr(error, "stderr", None) or str(error)
        raise LabError(f"what is in the wheel does not run: {said.strip().splitlines()[-1]}") from error


def _boot(init: Path, settings: list[str], timeout_s: float, tell: Callable[[str], None]) -> dict[str, Any]:
    said, far = os.pipe()
    log = os.memfd_create("kernel log")
    arguments = [
        f"mem={MEM_MB}M", "root=none", "rootfstype=hostfs", "rootflags=/", "rw",
        "con=null", "con0=null,fd:1", "ssl=null", f"con1=null,fd:{far}", "uml_dir=/proc/",
        "quiet", "panic=1", "noreboot", "initcall_blacklist=raid6_select_algo,calibrate_xor_blocks",
        f"init={init}", *settings,
    ]  # fmt: skip
    env = {"PATH": os.defpath}
    if shim.needed(Path("/proc/cpuinfo").read_text()):
        env["LD_PRELOAD"] = str(shim.library(shim.user_cache()))
    kernel = shutil.which(KERNEL)
    assert kernel
    guest = subprocess.Popen(
        [sys.executable, "-ISB", keeper.__file__, kernel, *arguments],
        stdin=subprocess.PIPE, stdout=log, stderr=log, env=env, cwd="/", start_new_session=True, pass_fds=[far],
    )  # fmt: skip
    os.close(far)
    try:
        result = _listen(said, time.monotonic() + timeout_s, tell)
    finally:
        assert guest.stdin
        with contextlib.suppress(subprocess.TimeoutExpired):
            guest.wait(0 if sys.exc_info()[0] else END_S)
        guest.stdin.close()  # the keeper's lifeline
        guest.wait()
        os.close(said)
    if result is None:
        lines = os.pread(log, 1 << 20, 0).decode(errors="replace").strip().splitlines()[-12:]
        raise LabError("\n  ".join(["the guest gave no result", *lines]))
    os.close(log)
    return result


def _listen(said: int, deadline_s: float, tell: Callable[[str], None]) -> dict[str, Any] | None:
    """Until the guest's result, its end or the deadline."""
    rest = b""
    while (left_s := deadline_s - time.monotonic()) > 0 and select.select([said], [], [], left_s)[0]:
        data = os.read(said, 65536)
        if not data:
            return None
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").strip()
            message = None
            with contextlib.suppress(json.JSONDecodeError):
                message = json.loads(text)
            if not isinstance(message, dict):
                tell(text)
            elif "result" in message:
                found: dict[str, Any] = message["result"]
                return found
            else:
                tell(f"{message['at_s']:7.1f} s  {message['event']}")
    return None
