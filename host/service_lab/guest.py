"""The steps inside the guest, as a service of its systemd: install, start, inspect, end in several ways, remove.

Argument: the order as a JSON file (``host.run``).  Prints JSON lines on stdout; the last one is the result.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import stat
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TextIO

from can_dbc.messages.envelope import SERVICE_KEY, read_key
from host.service_lab import authority, perception, trial, updates
from host.service_lab.pilot import Pilot
from host.systemd import journal, main_pid, process_facts, show, systemctl
from host.vcan_lab.guest import prioritize_soft_interrupts
from host.vcan_lab.spec import LabError
from recorder.recorder import TIMING
from recorder.recover import Stored, scan

PROGRAM: Final = "/opt/timberhand/current/bin/timberhand"
CONF: Final = Path("/etc/timberhand/timberhand.conf")
SERVICES: Final = ("controller", "guard", "perception", "recorder", "autonomy", "console")
PLANT_PORT: Final = 24720
CAMERA_PORT: Final = 24721
FIFO: Final = {"controller": 80, "guard": 85}
READY_S: Final = 0.1
"""Computing costs no simulated time: what is left is what a start waits for."""
NEUTRAL_MS: Final = 100.0
WORK_S: Final = 30.0
STILL_MRAD: Final = 10.0
"""Greatest motion of a crane with closed valves; a slewing crane exceeds it within a tenth of a second."""
IFF_UP: Final = 1
PILOT_PRIORITY, PLANT_PRIORITY, SYSTEMD_PRIORITY = 70, 50, 40


class Check:
    """The findings; ``failed`` holds sentences."""

    def __init__(self, out: TextIO) -> None:
        self.result: dict[str, Any] = {"failed": [], "figures": {}, "trials": []}
        self._out = out
        self._begin_s = time.monotonic()

    def step(self, event: str) -> None:
        """Report a step."""
        self._line({"event": event, "at_s": time.monotonic() - self._begin_s})

    def expect(self, true: object, sentence: str) -> None:
        """Record ``sentence`` as failed unless ``true``."""
        if not true:
            self.result["failed"].append(sentence)
            self.step(f"FAILED: {sentence}")

    def figure(self, name: str, value: float, limit: float) -> None:
        """Record a figure and compare it with its limit."""
        self.result["figures"][name] = value
        self.step(f"{name} = {value:.1f} (at most {limit:g})")
        self.expect(value <= limit, f"{name} is {value:.1f}, more than {limit:g}")

    def end(self) -> None:
        """Print the result."""
        self._line({"result": self.result})

    def _line(self, message: dict[str, Any]) -> None:
        self._out.write(json.dumps(message) + "\n")
        self._out.flush()


def carry_out(check: Check, what: str, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command like a user, and report its duration."""
    begin_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    check.step(f"{what}: {time.monotonic() - begin_s:.1f} s; {done.stderr.strip().splitlines()[-1:]}")
    return done


def install(check: Check, order: dict[str, str]) -> None:
    """Install from the wheel alone, with the packages of the given environment."""
    options = ("--python", order["python"], "--from-environment", order["environment"])
    done = carry_out(check, "install", order["python"], f"{order['wheel']}/deploy", *options)
    check.expect(done.returncode == 0, f"the installation ended with {done.returncode}: {done.stderr.strip()[-500:]}")


def uninstall(check: Check) -> None:
    """Uninstall with the installed program, which refuses to replace a running controller."""
    done = carry_out(check, "install over it", PROGRAM, "service", "install")
    check.expect(done.returncode == 5, f"a running controller is replaced: {done.returncode} {done.stderr}")
    done = carry_out(check, "uninstall", PROGRAM, "service", "uninstall")
    check.expect(done.returncode == 0, f"the removal ended with {done.returncode}: {done.stderr.strip()[-500:]}")


def change_settings(check: Check) -> dict[str, str]:
    """Change the settings like a technician; return all of them.

    This kernel has no /dev/cpu_dma_latency: a device that accepts every write replaces it, with the owner that the
    installed udev rule gives the real one.
    """
    device = Path("/dev/cpu_dma_latency")
    if not device.exists():
        os.mknod(device, stat.S_IFCHR | 0o600, os.makedev(1, 11))
        shutil.chown(device, "timberhand")
    text = CONF.read_text()
    check.expect("\nCONTROLLER_OPTIONS=\n" in text, "the settings have no CONTROLLER_OPTIONS")
    CONF.write_text(text.replace("\nCONTROLLER_OPTIONS=\n", "\nCONTROLLER_OPTIONS=--cpu 0 --dma-latency\n"))
    check.expect("\nCAMERA_FRAMES=zed\n" in text, "the settings have no CAMERA_FRAMES")
    CONF.write_text(CONF.read_text().replace("\nCAMERA_FRAMES=zed\n", f"\nCAMERA_FRAMES=127.0.0.1:{CAMERA_PORT}\n"))
    return dict(line.partition("=")[::2] for line in CONF.read_text().splitlines() if line and line[0] != "#")


def prioritize() -> None:
    """Set real-time priorities as in the vcan lab: frames and systemd must not wait for ordinary processes."""
    os.sched_setscheduler(1, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(SYSTEMD_PRIORITY))
    prioritize_soft_interrupts(Path("/proc"))


def bus_without_interface(check: Check) -> None:
    """Start a bus whose interface does not exist: one sentence, exit status 4."""
    systemctl("start", "timberhand-can@crane0.service")
    lines = [line for line in journal("timberhand-can@crane0.service") if line.startswith("can-up: ")]
    check.expect(
        len(lines) == 1 and "there is no CAN interface crane0" in lines[0],
        f"no sentence about the missing interface: {lines}",
    )


def plug_in(check: Check) -> None:
    """Add an interface; check that the installed udev rule sets it up."""
    subprocess.run(["ip", "link", "add", trial.INTERFACE, "type", "vcan"], check=True)
    flags = Path(f"/sys/class/net/{trial.INTERFACE}/flags")
    limit_s = time.monotonic() + 10.0
    while not (up := int(flags.read_text(), 16) & IFF_UP) and time.monotonic() < limit_s:
        time.sleep(0.2)
    check.expect(up, f"an interface that appeared is not set up: {journal('timberhand-can@crane0.service')}")


def start_plant(check: Check, *options: str) -> subprocess.Popen[str]:
    """Start the emulated machine with real-time priority."""
    bus = ("--bus", "crane0=socketcan:crane0", "--port", str(PLANT_PORT))
    command = [sys.executable, "-m", "sim", *bus, *options]
    environment = os.environ | {"PYTHONPATH": ":".join(sys.path[1:])}
    plant = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert plant.stdout
    check.expect(plant.stdout.readline() == "ready\n", "the plant does not start")
    os.sched_setscheduler(plant.pid, os.SCHED_FIFO, os.sched_param(PLANT_PRIORITY))
    return plant


def cold_start(check: Check) -> None:
    """Measure the time from the first start of the controller to READY."""
    started = systemctl("start", trial.CONTROLLER)
    check.expect(started.returncode == 0, f"the controller does not start: {journal(trial.CONTROLLER)[-5:]}")
    check.figure("cold_start_s", ready_s(), READY_S)


def ready_s() -> float:
    """Compute the time from the start of the present controller process to READY [s]."""
    times = show(trial.CONTROLLER, "ExecMainStartTimestampMonotonic", "ActiveEnterTimestampMonotonic")
    return (int(times["ActiveEnterTimestampMonotonic"]) - int(times["ExecMainStartTimestampMonotonic"])) * 1e-6


def _state(page: str) -> Any:
    with urllib.request.urlopen(f"{page}api/state", timeout=5.0) as answer:  # the page of this lab, http  # nosec B310
        return json.load(answer)


def wait_for_work(check: Check, page: str) -> None:
    """Start the target; wait until page, recorder, planner and perception work."""
    begin_s = time.monotonic()
    started = systemctl("start", "timberhand.target")
    check.expect(started.returncode == 0, f"the target does not start: {started.stderr}")
    waits_for = show("timberhand.target", "After")["After"].split()
    check.expect(perception.UNIT not in waits_for, "the target, and with it the boot, waits for the camera")
    state = show(perception.UNIT, "ActiveState")["ActiveState"]
    check.step(f"the target has started after {time.monotonic() - begin_s:.1f} s; perception is {state}")
    checks: dict[str, Callable[[], object]] = {
        # Page and recorder read the controller's timing page as different users.
        "console": lambda: _state(page)["timing"],
        "recorder": lambda: any(map(has_timing, Path("/var/lib/timberhand").glob("*/run.mcap"))),
        "perception": lambda: show(perception.UNIT, "ActiveState")["ActiveState"] == "active",
        "autonomy": lambda: any('"event":"phase"' in line for line in journal("timberhand-autonomy.service")),
    }
    limit_s = time.monotonic() + WORK_S
    while checks and time.monotonic() < limit_s:
        time.sleep(1.0)
        for name in tuple(checks):
            with contextlib.suppress(OSError):
                if checks[name]():
                    check.step(f"{name} works")
                    del checks[name]
    check.expect(not checks, f"no sign of work from {', '.join(checks)}")


def has_timing(recording: Path) -> bool:
    """Tell whether a running recording holds the controller's timing and frames of the bus."""
    frames = recording.with_name(f"{trial.INTERFACE}.log").stat().st_size
    return bool(frames) and any(isinstance(record, Stored) for record in scan(recording, {TIMING}))


def inspect(check: Check, page: str) -> None:
    """Check that all services run with the rights and priorities of their units, and the machine is not armed."""
    wait_for_work(check, page)
    users = set()
    for name in SERVICES:
        unit = f"timberhand-{name}.service"
        state = show(unit, "ActiveState", "StatusText", "NRestarts")
        alive = state["ActiveState"] == "active" and state["NRestarts"] == "0"
        check.expect(alive, f"{unit} is {state}: {journal(unit)[-12:]}")
        if not alive:
            continue
        facts = process_facts(main_pid(unit))
        check.result["figures"][f"{name}_locked_kb"] = facts["locked_kb"]
        users.add(facts["user"])
        expected_scheduling = ("fifo", FIFO[name]) if name in FIFO else ("other", 0)
        check.expect((facts["policy"], facts["priority"]) == expected_scheduling, f"{unit} is scheduled {facts}")
        check.expect(bool(facts["locked_kb"]) == (name in FIFO), f"{unit} has {facts['locked_kb']} kB locked")
        check.expect(name != "controller" or facts["processors"] == [0], f"{unit} runs on {facts['processors']}")
        check.expect(facts["capabilities"] == 0 and facts["no_new_privileges"] and facts["seccomp"], f"{unit}: {facts}")
        check.step(f"{name}: {facts}, {state['StatusText']!r}")
        refused = [line for line in journal(unit) if "not granted" in line]
        check.expect(not refused, f"{unit}: {refused}")
    authority.probe(check.expect, page)
    bridge = show("timberhand-plc.service", "ActiveState", "Result")
    check.expect(bridge == {"ActiveState": "inactive", "Result": "exec-condition"}, f"the PLC bridge is {bridge}")
    memory = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    check.result["figures"]["memory_left_mb"] = int(memory["MemAvailable"].split()[0]) >> 10
    check.expect(len(users) == len(SERVICES) and 0 not in users, f"the services share users: {users}")
    status = show(trial.CONTROLLER, "StatusText")["StatusText"]
    check.expect(status.startswith(("BOOT. ", "STANDBY. ")), f"the controller's status: {status!r}")
    status = show(trial.GUARD, "StatusText")["StatusText"]
    check.expect(status.startswith("Valves "), f"the guard's status: {status!r}")


def end_services(check: Check, pilot: Pilot) -> None:
    """End controller and guard in every way."""
    for ending in trial.ENDINGS:
        figures = trial.run_trial(ending, pilot)
        check.result["trials"].append(figures)
        check.step(f"{ending.name}: { ({name: value for name, value in figures.items() if name != 'feedback'}) }")
        evaluate_trial(check, ending, figures)
    for unit in (trial.CONTROLLER, trial.GUARD):
        watchdog = [line for line in journal(unit) if "Watchdog timeout" in line]
        check.expect(watchdog, f"systemd says nothing of a watchdog of {unit}")


def evaluate_trial(check: Check, ending: trial.Ending, figures: dict[str, Any]) -> None:
    """Check the figures of a trial."""
    name = ending.name
    check.figure(f"{name}_neutral_ms", figures["neutral_ms"], NEUTRAL_MS)
    check.result["figures"] |= {
        f"{name}_{figure_name}": figures[figure_name] for figure_name in ("no_flow_ms", "shut_ms", "ended_ms")
    }
    check.expect(trial.was_moving(figures), f"{name}: the crane did not move when the service ended")
    if not ending.signal:
        check.expect(figures["frames_when_stopped"] == 0, "frames of a controller that was stopped")
        check.expect(figures["state"] == "inactive", f"a stopped service is {figures['state']}")
        return
    check.result["figures"][f"{name}_back_ms"] = figures["back_ms"]
    back = figures["restarts"] == 1 and figures["another"] and figures["state"] == "active"
    check.expect(back, f"{name}: it did not come back once")
    check.expect(figures["frames_after"] > 0, f"{name}: afterwards the controller says nothing")
    check.expect(trial.is_idle(figures), f"{name}: afterwards the machine is armed: {figures['modes_after']}")
    if ending.unit == trial.GUARD:
        check.expect(figures["same_controller"], f"{name}: the controller went down with the guard")
        check.expect("FAULT" in figures["modes_after"], f"{name}: nothing is latched: {figures['modes_after']}")


def buses_lost(check: Check, pilot: Pilot, plant_port: int) -> None:
    """Check that the processes survive the loss of their bus, report it, and then need an operator but no restart."""
    for loss in trial.LOSSES:
        figures = trial.lose(loss, pilot, plant_port)
        check.result["trials"].append(figures)
        check.step(f"bus {loss.name}: {figures}")
        check.figure(f"bus_{loss.name}_moved_mrad", figures["moved_mrad"], STILL_MRAD)
        check.expect(figures["back_s"] is not None, f"the bus that was {loss.name} does not come back")
        check.result["figures"][f"bus_{loss.name}_back_s"] = figures["back_s"]
        check.expect(figures["same_processes"], f"bus {loss.name}: controller or guard ended")
        controller, guard = figures["status"][trial.CONTROLLER], figures["status"][trial.GUARD]
        check.expect(controller.startswith("FAULT. ") and "is DOWN." in controller, f"bus lost: {controller!r}")
        check.expect("not enabled" in guard and "is DOWN." in guard, f"bus lost: {guard!r}")
        check.expect(trial.is_idle(figures), f"bus {loss.name}: it came back armed: {figures['modes_after']}")


def check_status_command(check: Check) -> None:
    """Check `timberhand service status`."""
    status = json.loads(carry_out(check, "status", PROGRAM, "service", "status", "--json").stdout)
    running = {unit["name"] for unit in status["units"] if unit["state"] == "running"}
    check.expect(running >= set(SERVICES), f"the status shows {status['units']}")
    timing = status["timing"]
    check.expect(timing and not timing["silent"] and timing["ticks"] > 100, f"the status shows {timing}")
    shown = carry_out(check, "status", PROGRAM, "service", "status").stdout
    check.expect("wake-up late" in shown and "crane0" in shown, f"the status: {shown}")
    check.result["status"] = shown


def check_removal(check: Check) -> None:
    """Check that nothing is left that could start."""
    check.expect(not Path("/opt/timberhand").exists(), "the program is still there")
    check.expect(show("timberhand.target", "LoadState")["LoadState"] == "not-found", "the target is still there")
    check.expect(not Path("/etc/timberhand/timberhand.conf").exists(), "unchanged settings are still there")


def run_loading(check: Check, order: dict[str, str]) -> None:
    """Load one log into the bunk, for a guest whose time is simulated."""
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    install(check, order)
    conf = change_settings(check)
    plug_in(check)
    plant = start_plant(check, "--camera", str(CAMERA_PORT))
    page = f"http://127.0.0.1:{conf['CONSOLE_PORT']}/"
    wait_for_work(check, page)
    for name, value in authority.load_a_log(page, PLANT_PORT, check.expect, check.step).items():
        check.result["figures"][f"loading_{name}"] = value
    plant.terminate()


def run(check: Check, order: dict[str, str]) -> None:
    """End services and buses in every way."""
    facts = {"kernel": platform.release(), "systemd": systemctl("--version").stdout.splitlines()[0]}
    check.result["environment"] = facts | {"python": platform.python_version()}
    prioritize()
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    install(check, order)
    idle = systemctl("is-active", trial.CONTROLLER).stdout.strip() == "inactive"
    enabled = systemctl("is-enabled", "timberhand.target", trial.CONTROLLER).stdout.split() == ["enabled"] * 2
    check.expect(idle and enabled, "after the installation the services are not enabled, or they run")
    shipped = CONF.read_text()
    conf = change_settings(check)
    bus_without_interface(check)
    plug_in(check)
    plant = start_plant(check)
    cold_start(check)
    inspect(check, f"http://127.0.0.1:{conf['CONSOLE_PORT']}/")
    check_status_command(check)
    for name, value in perception.try_perception(CAMERA_PORT, check.expect, check.step).items():
        check.result["figures"][f"perception_{name}"] = value
    for name, value in updates.try_updates(order, plant, check.expect, check.step).items():
        check.result["figures"][f"update_{name}"] = value
    systemctl("stop", "timberhand-autonomy.service")  # the pilot replaces the planner
    ports = int(conf["SETPOINT_PORT"]), int(conf["PLANNER_PORT"])
    pilot = Pilot(conf["PROFILE"], ports[0], authority.OPERATORS, ports[1], conf["CRANE_BUS"], read_key(SERVICE_KEY))
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PILOT_PRIORITY))
    end_services(check, pilot)
    buses_lost(check, pilot, PLANT_PORT)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    plant.terminate()
    CONF.write_text(shipped)
    uninstall(check)
    check_removal(check)


def main() -> None:
    """Run the steps; in any case print a result and power off."""
    os.environ.pop("PYTHONPATH", None)  # for this process only; the installed program must not need it
    check = Check(sys.stdout)
    try:
        order = json.loads(Path(sys.argv[1]).read_text())
        (run_loading if order["steps"] == "loading" else run)(check, order)
    except (OSError, ValueError, KeyError, subprocess.SubprocessError, LabError) as error:
        check.expect(False, f"the test was aborted: {type(error).__name__}: {error}")
    check.end()
    systemctl("poweroff", "--force", "--force")


if __name__ == "__main__":
    main()
