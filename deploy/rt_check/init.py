"""First process of the guest: starts guard and controller with emulated nodes and checks them.

Prints one line, ``RESULT`` and a JSON object; then the guest powers off.  ``/check.json`` holds the paths of Python and
the checkout.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

MODULES = ("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan")
BUS = "crane0"
PROFILE = "palms_471"
SETPOINTS, REPORTS = 24701, 24702
TIMEOUT_S = 240.0
"""Time limit of every wait, in time of the guest."""
TICKS_S = 3.0
RUNTIME = Path("/run/timberhand")
_POWER_OFF = 0x4321_FEDC
_SYS_FINIT_MODULE = 313
libc = ctypes.CDLL(None, use_errno=True)


def main() -> None:
    where = json.loads(Path("/check.json").read_text())
    sys.path[:0] = where["path"]
    os.environ |= {"PATH": "/usr/bin:/bin", "PYTHONPATH": ":".join(where["path"]), "RUNTIME_DIRECTORY": str(RUNTIME)}
    result: dict[str, Any] = {"kernel": " ".join((os.uname().release, os.uname().version))}
    try:
        set_up()
        result |= run(where["python"], Path(where["path"][0]))
    except Exception as error:  # noqa: BLE001  the first process reports every error
        result["error"] = f"{type(error).__name__}: {error}"
    for said in sorted(RUNTIME.glob("*.err")):
        sys.stdout.write(f"{said.stem}: {said.read_text()[-1500:]}\n")
    sys.stdout.write(f"RESULT {json.dumps(result)}\n")
    sys.stdout.flush()
    time.sleep(0.2)
    libc.reboot(_POWER_OFF)


def set_up() -> None:
    """Mount file systems, load CAN, create one virtual bus."""
    places = {
        "/proc": "proc",
        "/sys": "sysfs",
        "/dev": "devtmpfs",
        "/run": "tmpfs",
        "/dev/shm": "tmpfs",
    }
    for place, kind in places.items():
        os.makedirs(place, exist_ok=True)
        libc.mount(kind.encode(), place.encode(), kind.encode(), 0, None)
    RUNTIME.mkdir()
    for name in MODULES:
        with open(f"/lib/modules/{os.uname().release}/kernel/{name}.ko", "rb") as module:
            if libc.syscall(_SYS_FINIT_MODULE, module.fileno(), b"", 0):
                raise OSError(ctypes.get_errno(), f"module {name}: {os.strerror(ctypes.get_errno())}")
    from host.vcan_lab import links

    links.create([BUS])


def run(python: str, checkout: Path) -> dict[str, Any]:
    """Run all checks; the results by name."""
    bus = ("--profile", PROFILE, "--bus", f"crane0=socketcan:{BUS}")
    reports = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    reports.bind(("127.0.0.1", REPORTS))
    began_s = time.monotonic()
    nodes, _ = start(python, checkout, "experiments.timing.emulated_machine", *bus)
    if not await_text(nodes, RUNTIME / "experiments.timing.emulated_machine.out", "ready"):
        raise TimeoutError("the emulated nodes do not start")
    guard, guard_ready = start(python, checkout, "controller.guard", *bus)
    controller, controller_ready = start(
        python, checkout, "controller", *bus, "--setpoint-port", SETPOINTS, "--report", f"127.0.0.1:{REPORTS}",
        "--timing", RUNTIME / "controller.timing",
    )  # fmt: skip
    found: dict[str, Any] = {
        "guard_ready": await_ready(guard_ready), "controller_ready": await_ready(controller_ready),
        "ready_after_s": round(time.monotonic() - began_s, 1),
    }  # fmt: skip
    found["standby"] = await_mode(reports, "STANDBY")
    time.sleep(TICKS_S)
    for name, process in (("controller", controller), ("guard", guard)):
        status = dict(line.split(":\t", 1) for line in Path(f"/proc/{process.pid}/status").read_text().splitlines())
        policy, priority = os.sched_getscheduler(process.pid), os.sched_getparam(process.pid).sched_priority
        found[f"{name}_policy"] = f"{'FIFO' if policy == os.SCHED_FIFO else policy} {priority}"
        found[f"{name}_locked_kb"] = int(status["VmLck"].split()[0])
    statistics = Path(f"/sys/class/net/{BUS}/statistics/rx_packets")
    found["frames"] = int(statistics.read_text())
    for process in (controller, guard, nodes):
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(30)
    found["controller_status"] = controller.returncode
    with contextlib.suppress(ValueError, OSError):
        told = json.loads((RUNTIME / "controller.out").read_text())
        found |= {"ticks": told["ticks"], "missed": told["missed"]}
    return found


def start(python: str, checkout: Path, module: str, *words: object) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start a process like systemd (Type=notify); its notifications arrive at the socket."""
    place = f"/run/timberhand/{module}.notify"
    notified = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    notified.bind(place)
    with open(RUNTIME / f"{module}.out", "wb") as out, open(RUNTIME / f"{module}.err", "wb") as err:
        process = subprocess.Popen(
            [python, "-m", module, *map(str, words)], cwd=checkout, stdin=subprocess.DEVNULL, stdout=out, stderr=err,
            env=os.environ | {"NOTIFY_SOCKET": place},
        )  # fmt: skip
    return process, notified


def await_ready(notified: socket.socket) -> bool:
    """Whether READY=1 arrives."""
    limit_s = time.monotonic() + TIMEOUT_S
    while (left_s := limit_s - time.monotonic()) > 0 and select.select([notified], [], [], left_s)[0]:
        if b"READY=1" in notified.recv(4096):
            return True
    return False


def await_text(process: subprocess.Popen[bytes], out: Path, word: str) -> bool:
    """Whether a process prints ``word`` before it ends."""
    limit_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < limit_s and process.poll() is None:
        if word in out.read_text():
            return True
        time.sleep(0.1)
    return False


def await_mode(reports: socket.socket, wanted: str) -> bool:
    """Whether the controller reaches a mode; STANDBY requires answers of every encoder."""
    from can_dbc.messages.crane import StateReport
    from can_dbc.messages.datagrams import decode
    from machine.status.modes import Mode

    limit_s = time.monotonic() + TIMEOUT_S
    while (left_s := limit_s - time.monotonic()) > 0 and select.select([reports], [], [], left_s)[0]:
        report = decode(reports.recv(2048))
        if isinstance(report, StateReport) and Mode(report.mode).name == wanted:
            return True
    return False


if __name__ == "__main__":
    main()
