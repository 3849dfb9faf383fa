"""Boots the guest, collects its result, and checks it.  Failure: ``LabError``.

The guest prints ``STEP`` lines, then one line ``RESULT`` with a JSON object, on its console.
"""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from host.rt_lab.files import make_archive
from host.rt_lab.package import kernel_package, unpack
from host.vcan_lab.spec import LabError

QEMU: Final = "qemu-system-x86_64"
PROGRAMS: Final = {QEMU: "qemu-system-x86", "cpio": "cpio", "dpkg-deb": "dpkg", "cyclictest": "rt-tests"}
MEM_MB: Final = 1536
NEUTRAL_MS: Final = 100.0
"""Limit for the valves after the controller is killed, as in the service lab."""
EXPECTED: Final[dict[str, Any]] = {
    "realtime": "1",
    "guard_ready": True,
    "controller_ready": True,
    "standby": True,
    "controller_policy": "fifo 80",
    "guard_policy": "fifo 85",
    "refused": [],
    "cyclictest_status": 0,
}
POSITIVE: Final = ("controller_locked_kb", "guard_locked_kb", "frames", "ticks", "cyclictest_cycles", "opening_pct")


def missing() -> str | None:
    """Why this computer cannot run the lab; None when it can, given a kernel package."""
    if platform.machine() != "x86_64":
        return f"the guest needs the packages of this computer, which is {platform.machine()} and not x86_64"
    for program, package in PROGRAMS.items():
        if shutil.which(program) is None:
            return f"{program} is missing: sh deploy/debian_packages.sh {package}"
    return None


def run(package: Path | None, accelerator: str, timeout_s: float, show: Callable[[str], None]) -> dict[str, Any]:
    """Boot the guest and return its result.

    Raises:
        LabError: it cannot run here, or gives no result.
    """
    if fault := missing():
        raise LabError("rt-lab.missing", fault)
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="timberhand-rt-") as place:
        work = Path(place)
        kernel, modules = unpack(package or kernel_package(show), work / "kernel")
        archive = make_archive(work, modules)
        size_mb = archive.stat().st_size >> 20
        show(f"booting {kernel.name} with {size_mb} MB of files")
        result = _boot(kernel, archive, accelerator, timeout_s, show)
    return result | {"files_mb": size_mb, "seconds": round(time.monotonic() - begin_s)}


def evaluate(result: dict[str, Any]) -> list[str]:
    """One sentence for each check that failed."""
    faults = [f"the guest reports: {result['error']}"] if "error" in result else []
    if "PREEMPT_RT" not in result.get("kernel", ""):
        faults.append(f"the kernel is not PREEMPT_RT: {result.get('kernel', 'unknown')}")
    faults += [f"{k} is {result.get(k)}, not {v}" for k, v in EXPECTED.items() if result.get(k) != v]
    faults += [f"{k} is {result.get(k)}" for k in POSITIVE if not result.get(k)]
    neutral_ms = result.get("neutral_ms")
    if neutral_ms is None or neutral_ms > NEUTRAL_MS:
        faults.append(f"neutral_ms is {neutral_ms}, the limit {NEUTRAL_MS:g}")
    return faults


def _boot(
    kernel: Path, archive: Path, accelerator: str, timeout_s: float, show: Callable[[str], None]
) -> dict[str, Any]:
    # When emulated, the guest's clock counts instructions, so that a slow host does not delay its loops.
    clock = ["-icount", "shift=0,sleep=off", "-rtc", "clock=vm"] if accelerator == "tcg" else []
    command = [
        QEMU,
        "-accel",
        accelerator,
        *clock,
        "-cpu",
        "max",
        "-smp",
        "1",
        "-m",
        str(MEM_MB),
        "-kernel",
        str(kernel),
        "-initrd",
        str(archive),
        "-append",
        "console=ttyS0 quiet panic=-1 rdinit=/init",
        "-nographic",
        "-no-reboot",
        "-nic",
        "none",
    ]
    console: list[str] = []
    result: dict[str, Any] | None = None
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as guest:
        limit = threading.Timer(timeout_s, guest.kill)
        limit.start()
        try:
            assert guest.stdout
            for line in guest.stdout:
                text = line.decode(errors="replace").rstrip()
                kind, _, rest = text.partition(" ")
                if kind.endswith("RESULT"):
                    result = json.loads(rest)
                elif kind.endswith("STEP"):
                    show(rest)
                else:
                    console.append(text)
        finally:
            limit.cancel()
            guest.kill()
    if result is None:
        raise LabError("rt-lab.no-result", "\n  ".join(["the guest gave no result", *console[-12:]]))
    for text in console if evaluate(result) else ():
        show(f"console: {text}")
    return result
