"""First process of the guest: runs the checks on the real-time kernel, prints the result, powers off.

``/order.json`` holds the paths of Python and the checkout.  Started without
site-packages, so our own modules are imported after the path is set.
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
LINKS = ("vcan0", "vcan1")
PROFILE = "palms_471"
SETPOINTS, REPORTS = 24701, 24702
NODES_PRIORITY, PILOT_PRIORITY = 50, 70
WAIT_S = 120.0
"""Time limit of every wait, in time of the guest."""
TICKS_S = 2.0
AFTER_KILL_S = 0.6
CYCLES = 300
RUNTIME = Path("/run/timberhand")
_POWER_OFF = 0x4321_FEDC
_SYS_FINIT_MODULE = 313
libc = ctypes.CDLL(None, use_errno=True)


def main() -> None:
    order = json.loads(Path("/order.json").read_text())
    sys.path[:0] = order["path"]
    os.environ |= {
        "PATH": "/usr/bin:/bin",
        "PYTHONPATH": ":".join(order["path"]),
        "RUNTIME_DIRECTORY": str(RUNTIME),
        "HOME": "/run",
        "TMPDIR": "/run",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "TERM": "dumb",
    }
    sys.executable = order["python"]
    result: dict[str, Any] = {"kernel": " ".join((os.uname().release, os.uname().version))}
    try:
        set_up()
        result["realtime"] = Path("/sys/kernel/realtime").read_text().strip()
        result |= reference_loop()
        result |= control_loop(Path(order["path"][0]))
    except Exception as error:  # noqa: BLE001  the first process reports every error
        result["error"] = f"{type(error).__name__}: {error}"
    for log_path in sorted(RUNTIME.glob("*.err")):
        print(f"{log_path.stem}: {log_path.read_text()[-1500:]}")
    print(f"RESULT {json.dumps(result)}", flush=True)
    time.sleep(0.2)
    libc.reboot(_POWER_OFF)


def step(text: str) -> None:
    print(f"STEP {time.monotonic():6.1f} s  {text}", flush=True)


def set_up() -> None:
    """Mount file systems, load CAN, create the virtual buses."""
    mounts = {"/proc": "proc", "/sys": "sysfs", "/dev": "devtmpfs", "/run": "tmpfs"}
    mounts["/dev/shm"] = "tmpfs"  # mounted here, in a machine of its own  # nosec B108
    for mount_point, kind in mounts.items():
        os.makedirs(mount_point, exist_ok=True)
        libc.mount(kind.encode(), mount_point.encode(), kind.encode(), 0, None)
    RUNTIME.mkdir()
    for name in MODULES:
        with open(f"/lib/modules/{os.uname().release}/kernel/{name}.ko", "rb") as module:
            if libc.syscall(_SYS_FINIT_MODULE, module.fileno(), b"", 0):
                raise OSError(ctypes.get_errno(), f"module {name}: {os.strerror(ctypes.get_errno())}")
    from host.vcan_lab import links

    links.create(LINKS)
    step(f"{os.uname().version}; {' and '.join(LINKS)} are up")


def reference_loop() -> dict[str, Any]:
    """Run cyclictest at the controller's priority with locked memory."""
    report = RUNTIME / "cyclictest.json"
    command = ["cyclictest", "-q", "-m", "-t", "1", "-p", "80", "--policy", "fifo", "-i", "2000", "-l", str(CYCLES)]
    with open(RUNTIME / "cyclictest.err", "wb") as err:
        done = subprocess.run([*command, f"--json={report}"], stdout=err, stderr=err, check=False)
    thread = json.loads(report.read_text())["thread"]["0"] if report.exists() else {}
    step(f"cyclictest: {thread.get('cycles')} cycles")
    return {"cyclictest_status": done.returncode, "cyclictest_cycles": thread.get("cycles")}


def control_loop(checkout: Path) -> dict[str, Any]:
    """Run controller, guard and emulated nodes on vcan; the controller is killed while the crane slews."""
    from can_dbc.messages.envelope import read_key, write_key
    from can_dbc.timing.page import read_timing
    from host.service_lab import trial
    from host.service_lab.pilot import Pilot
    from host.systemd import process_facts
    from machine.status.modes import Mode

    bus = ("--profile", PROFILE, "--bus", f"crane0=socketcan:{LINKS[0]}")
    nodes, _ = start(checkout, "experiments.timing.stand_ins", "machine", *bus)
    if not await_text(nodes, RUNTIME / "experiments.timing.stand_ins.out", "ready"):
        raise TimeoutError("the emulated nodes do not start")
    os.sched_setscheduler(nodes.pid, os.SCHED_FIFO, os.sched_param(NODES_PRIORITY))
    page, operator = RUNTIME / "controller.timing", RUNTIME / "controller.operator"
    key_file = write_key(RUNTIME / "key")
    guard, guard_ready = start(checkout, "controller.guard", *bus, "--operator", operator)
    controller, controller_ready = start(
        checkout,
        "controller",
        *bus,
        "--setpoint-port",
        SETPOINTS,
        "--report",
        f"127.0.0.1:{REPORTS}",
        "--timing",
        page,
        "--operator",
        operator,
        "--key-file",
        key_file,
    )
    figures: dict[str, Any] = {
        "guard_ready": await_ready(guard_ready),
        "controller_ready": await_ready(controller_ready),
    }
    step(f"guard and controller are ready: {figures}")
    pilot = Pilot(PROFILE, SETPOINTS, operator, REPORTS, f"socketcan:{LINKS[0]}", read_key(key_file))
    figures["standby"] = pilot.until(lambda: pilot.report and Mode(pilot.report.mode) is Mode.STANDBY, WAIT_S)
    pilot.until(lambda: False, TICKS_S)
    for name, process in (("controller", controller), ("guard", guard)):
        facts = process_facts(process.pid)
        figures[f"{name}_policy"] = f"{facts['policy']} {facts['priority']}"
        figures[f"{name}_locked_kb"] = facts["locked_kb"]
    refusals = [line for name in ("controller", "controller.guard") for line in said(name) if "not granted" in line]
    timing = read_timing(page).facts
    figures |= {"refused": refusals, "ticks": timing.ticks, "missed": timing.missed, "tick": timing.tick}
    step(f"the controller is in {timing.mode} after {timing.ticks} ticks, {timing.missed} missed")
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PILOT_PRIORITY))
    trial.slew_until_fast(pilot)
    figures["opening_pct"] = pilot.opening_pct()
    pilot.clear()
    killed_ns = time.monotonic_ns()
    controller.kill()
    pilot.until(lambda: False, AFTER_KILL_S)
    figures["neutral_ms"] = trial.time_after(pilot, killed_ns, lambda v: v.state in trial.MOVING)
    figures["shut_ms"] = trial.time_after(pilot, killed_ns, lambda v: v.opening_pct > trial.SHUT_PCT)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    step(f"killed at an opening of {figures['opening_pct']:.0f} %; neutral after {figures['neutral_ms']:.1f} ms")
    figures["frames"] = int(Path(f"/sys/class/net/{LINKS[0]}/statistics/rx_packets").read_text())
    for process in (guard, nodes, controller):
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(30)
    return figures


def start(checkout: Path, module: str, *words: object) -> tuple[subprocess.Popen[bytes], socket.socket]:
    """Start a process like systemd (Type=notify); its notifications arrive at the socket."""
    socket_path = f"{RUNTIME}/{module}.notify"
    notified = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    notified.bind(socket_path)
    with open(RUNTIME / f"{module}.out", "wb") as out, open(RUNTIME / f"{module}.err", "wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, words)],
            cwd=checkout,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env=os.environ | {"NOTIFY_SOCKET": socket_path},
        )
    return process, notified


def said(module: str) -> list[str]:
    return (RUNTIME / f"{module}.err").read_text().splitlines()


def await_ready(notified: socket.socket) -> bool:
    """Wait for READY=1; tell whether it arrives."""
    limit_s = time.monotonic() + WAIT_S
    while (left_s := limit_s - time.monotonic()) > 0 and select.select([notified], [], [], left_s)[0]:
        if b"READY=1" in notified.recv(4096):
            return True
    return False


def await_text(process: subprocess.Popen[bytes], out: Path, word: str) -> bool:
    """Wait until a process prints ``word``; tell whether it does before it ends."""
    limit_s = time.monotonic() + WAIT_S
    while time.monotonic() < limit_s and process.poll() is None:
        if word in out.read_text():
            return True
        time.sleep(0.1)
    return False


if __name__ == "__main__":
    main()
