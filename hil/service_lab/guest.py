"""The steps inside the guest, as a service of its systemd: install, start, look, end in three ways, remove.

Argument: the order as a JSON file (``host.run``).  Says JSON lines on stdout; the last one is the result.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import select
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any, Final, TextIO

from hil.service_lab import trial
from hil.service_lab.pilot import Pilot
from hil.service_lab.systemd import journal, main_pid, process_facts, show, systemctl
from machine.modes import Mode

SERVICES: Final = ("controller", "guard", "recorder", "autonomy", "console")
FIFO: Final = {"controller": 80, "guard": 85}
READY_S: Final = 2.0
SLOW_PYTHON_S: Final = 0.3
"""Where Python alone takes longer to start and end, the host is too busy to judge a start."""
NEUTRAL_MS: Final = 100.0
TRIES: Final = 4
WORK_S: Final = 60.0
PILOT_PRIORITY, PLANT_PRIORITY, SOFT_INTERRUPT_PRIORITY = 70, 50, 95


class Check:
    """The findings so far.  ``failed`` and ``inconclusive`` hold sentences."""

    def __init__(self, out: TextIO) -> None:
        self.result: dict[str, Any] = {"failed": [], "inconclusive": [], "figures": {}, "trials": []}
        self._out = out
        self._begin_s = time.monotonic()

    def say(self, event: str) -> None:
        """A step, for whoever waits."""
        self._line({"event": event, "at_s": time.monotonic() - self._begin_s})

    def expect(self, true: object, sentence: str) -> None:
        """Note ``sentence`` as failed unless ``true``."""
        if not true:
            self.result["failed"].append(sentence)
            self.say(f"FAILED: {sentence}")

    def figure(self, name: str, value: float, limit: float, disturbed: bool = False) -> None:
        """Note a figure and compare it to its bound."""
        self.result["figures"][name] = value
        self.say(f"{name} = {value:.1f} (at most {limit:g})")
        if value > limit and disturbed:
            self.result["inconclusive"].append(f"{name}: the host was too busy while it was taken")
        else:
            self.expect(value <= limit, f"{name} is {value:.1f}, more than {limit:g}")

    def end(self) -> None:
        """Hand the result out."""
        self._line({"result": self.result})

    def _line(self, message: dict[str, Any]) -> None:
        self._out.write(json.dumps(message) + "\n")
        self._out.flush()


def install(check: Check, order: dict[str, str], *more: str) -> None:
    """As a user would, but for where the packages come from."""
    words = ["sh", order["install"], "--wheel", order["wheel"], "--python", order["python"]]
    begin_s = time.monotonic()
    done = subprocess.run(
        [*words, "--from-environment", order["environment"], *more], capture_output=True, text=True, check=False
    )
    check.say(f"install {' '.join(more)}: {time.monotonic() - begin_s:.1f} s; {done.stderr.strip().splitlines()[-1:]}")
    check.expect(done.returncode == 0, f"install.sh ended with {done.returncode}: {done.stderr.strip()[-500:]}")


def hasten_soft_interrupts() -> None:
    """As in the vcan lab: a frame must not wait behind an ordinary process."""
    for comm in Path("/proc").glob("[0-9]*/comm"):
        if comm.read_text().startswith("ksoftirqd"):
            os.sched_setscheduler(int(comm.parent.name), os.SCHED_FIFO, os.sched_param(SOFT_INTERRUPT_PRIORITY))


def bus_without_interface(check: Check) -> None:
    """The settings name an interface that is not there: one sentence, exit status 4."""
    systemctl("start", "timberhand-can@crane0.service")
    said = [line for line in journal("timberhand-can@crane0.service") if line.startswith("can-up: ")]
    check.expect(len(said) == 1 and "there is no CAN interface crane0" in said[0], f"no sentence on the bus: {said}")


def start_plant(check: Check, port: str) -> subprocess.Popen[str]:
    """The emulated machine, in time like hardware."""
    systemctl("start", "timberhand-can@crane0.service")
    link = subprocess.run(["ip", "link", "show", "crane0"], capture_output=True, text=True, check=False).stdout
    check.expect("UP" in link, f"can-up left the interface down: {link}")
    command = [sys.executable, "-m", "sim", "--bus", "crane0=socketcan:crane0", "--port", port]
    plant = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert plant.stdout
    check.expect(plant.stdout.readline() == "ready\n", "the plant does not start")
    os.sched_setscheduler(plant.pid, os.SCHED_FIFO, os.sched_param(PLANT_PRIORITY))
    return plant


def cold_start(check: Check) -> None:
    """From the first start of the controller's process to READY, beside what Python alone needs."""
    begin_s = time.monotonic()
    subprocess.run(["/opt/timberhand/bin/python", "-P", "-c", "pass"], check=False, cwd="/")
    python_s = time.monotonic() - begin_s
    started = systemctl("start", trial.UNIT)
    check.expect(started.returncode == 0, f"the controller does not start: {journal(trial.UNIT)[-5:]}")
    check.result["figures"]["python_start_s"] = python_s
    check.figure("cold_start_s", ready_s(), READY_S, python_s > SLOW_PYTHON_S)


def ready_s() -> float:
    """From the controller's process to READY, in its present life."""
    times = show(trial.UNIT, "ExecMainStartTimestampMonotonic", "ActiveEnterTimestampMonotonic")
    return (int(times["ActiveEnterTimestampMonotonic"]) - int(times["ExecMainStartTimestampMonotonic"])) * 1e-6


def wait_for_work(check: Check, page: str) -> None:
    """Start the target, and wait until those who say nothing to systemd do their work: page, recording, planner."""
    started = systemctl("start", "timberhand.target")
    check.expect(started.returncode == 0, f"the target does not start: {started.stderr}")
    works = {
        "console": lambda: urllib.request.urlopen(page, timeout=5.0).status == 200,
        "recorder": lambda: any(log.stat().st_size for log in Path("/var/lib/timberhand").glob("*/crane0.log")),
        "autonomy": lambda: any('"event":"phase"' in line for line in journal("timberhand-autonomy.service")),
    }
    limit_s = time.monotonic() + WORK_S
    while works and time.monotonic() < limit_s:
        time.sleep(1.0)
        for name in tuple(works):
            with contextlib.suppress(OSError):
                if works[name]():
                    check.say(f"{name} works")
                    del works[name]
    check.expect(not works, f"no sign of work from {', '.join(works)}")


def look(check: Check, page: str) -> None:
    """The whole machine runs, with the rights and the timing that the units promise, and is not armed."""
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
        wanted = ("fifo", FIFO[name]) if name in FIFO else ("other", 0)
        check.expect((facts["policy"], facts["priority"]) == wanted, f"{unit} is scheduled {facts}")
        check.expect(bool(facts["locked_kb"]) == (name in FIFO), f"{unit} has {facts['locked_kb']} kB locked")
        check.expect(facts["capabilities"] == 0 and facts["no_new_privileges"] and facts["seccomp"], f"{unit}: {facts}")
        check.say(f"{name}: {facts}, {state['StatusText']!r}")
        refused = [line for line in journal(unit) if "not granted" in line]
        check.expect(not refused, f"{unit}: {refused}")
    memory = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    check.result["figures"]["memory_left_mb"] = int(memory["MemAvailable"].split()[0]) >> 10
    check.expect(len(users) == len(SERVICES) and 0 not in users, f"the services share users: {users}")
    status = show(trial.UNIT, "StatusText")["StatusText"]
    check.expect(status.startswith(("BOOT. ", "STANDBY. ")), f"the controller's status: {status!r}")
    status = show("timberhand-guard.service", "StatusText")["StatusText"]
    check.expect(status.startswith("Valves "), f"the guard's status: {status!r}")


def ends(check: Check, pilot: Pilot) -> None:
    """Every way to end the controller, repeated while the guest stood still in the window that matters."""
    for way in trial.WAYS:
        for _ in range(TRIES):
            try:
                figures = trial.end(way, pilot)
            except ProcessLookupError:
                check.say(f"{way}: a busy host ended the controller before we did")
                continue
            figures["ready_s"] = ready_s()
            check.result["trials"].append(figures)
            check.say(f"{way}: { ({name: value for name, value in figures.items() if name != 'feedback'}) }")
            late = figures["neutral_ms"] > NEUTRAL_MS and trial.disturbed(figures)
            if trial.moving(figures) and not late:
                break
        judge_end(check, way, check.result["trials"][-1])
    watchdog = [line for line in journal(trial.UNIT) if "Watchdog timeout" in line]
    check.expect(watchdog, "systemd says nothing of a watchdog")


def judge_end(check: Check, way: str, figures: dict[str, Any]) -> None:
    """What must be true of a trial."""
    check.figure(f"{way}_neutral_ms", figures["neutral_ms"], NEUTRAL_MS, trial.disturbed(figures))
    check.result["figures"] |= {f"{way}_{name}": figures[name] for name in ("no_flow_ms", "shut_ms", "ended_ms")}
    check.expect(trial.moving(figures), f"{way}: the crane did not swing when the controller was ended")
    if way == "stop":
        check.expect(figures["frames_when_stopped"] == 0, "frames of a controller that was stopped")
        check.expect(figures["state"] == "inactive", f"a stopped service is {figures['state']}")
        return
    check.result["figures"][f"{way}_back_ms"] = figures["back_ms"]
    back = figures["restarts"] == 1 and figures["another"] and figures["state"] == "active"
    check.expect(back, f"{way}: it did not come back once")
    check.expect(figures["frames_after"] > 0, f"{way}: it came back and says nothing")
    idle = not figures["armed_after"] and not {"ARMED", "ACTIVE"} & set(figures["modes_after"])
    check.expect(idle and figures["opening_after_pct"] <= trial.SHUT_PCT, f"{way}: it came back armed")


def bus_lost(check: Check, pilot: Pilot) -> None:
    """The interface goes down under the controller: it ends, and the next start sets the interface up again."""
    before = show(trial.UNIT, "NRestarts", "MainPID")
    gone = os.pidfd_open(int(before["MainPID"]))
    subprocess.run(["ip", "link", "set", "crane0", "down"], check=True)
    ended = pilot.until(lambda: select.select([gone], [], [], 0)[0], 10.0)
    check.expect(ended, "a controller without a bus goes on")
    pilot.report = None
    back = pilot.until(lambda: pilot.report and pilot.report.mode == Mode.STANDBY, 30.0)
    after = show(trial.UNIT, "ActiveState", "NRestarts", "StatusText")
    check.say(f"bus lost: {before} {after}")
    check.expect(back and after["ActiveState"] == "active", f"it does not come back with the bus: {after}")


def removed(check: Check) -> None:
    """Nothing of it is left that could start."""
    check.expect(not Path("/opt/timberhand").exists(), "the program is still there")
    check.expect(show("timberhand.target", "LoadState")["LoadState"] == "not-found", "the target is still there")
    check.expect(not Path("/etc/timberhand/timberhand.conf").exists(), "unchanged settings are still there")


def run(check: Check, order: dict[str, str]) -> None:
    """All steps."""
    facts = {"kernel": platform.release(), "systemd": systemctl("--version").stdout.splitlines()[0]}
    check.result["environment"] = facts | {"python": platform.python_version()}
    hasten_soft_interrupts()
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    install(check, order)
    idle = systemctl("is-active", trial.UNIT).stdout.strip() == "inactive"
    enabled = systemctl("is-enabled", "timberhand.target", trial.UNIT).stdout.split() == ["enabled"] * 2
    check.expect(idle and enabled, "after the installation the services are not enabled, or they run")
    bus_without_interface(check)
    for bus in ("crane0", "mach0"):
        subprocess.run(["ip", "link", "add", bus, "type", "vcan"], check=True)
    lines = Path("/etc/timberhand/timberhand.conf").read_text().splitlines()
    conf = dict(line.partition("=")[::2] for line in lines if line and not line.startswith("#"))
    plant = start_plant(check, conf["SCENE"].rpartition(":")[2])
    cold_start(check)
    look(check, f"http://127.0.0.1:{conf['CONSOLE_PORT']}/")
    systemctl("stop", "timberhand-autonomy.service")  # the pilot plans
    pilot = Pilot(conf["PROFILE"], int(conf["SETPOINT_PORT"]), int(conf["PLANNER_PORT"]), conf["CRANE_BUS"])
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PILOT_PRIORITY))
    ends(check, pilot)
    bus_lost(check, pilot)
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    installed_again = subprocess.run(["sh", order["install"]], capture_output=True, text=True, check=False)
    check.expect(installed_again.returncode == 5, "install.sh does not refuse to replace a running controller")
    plant.terminate()
    install(check, order, "--uninstall")
    removed(check)


def main() -> None:
    """Whatever happens, there is a result, and the guest ends."""
    check = Check(sys.stdout)
    try:
        run(check, json.loads(Path(sys.argv[1]).read_text()))
    except (OSError, ValueError, KeyError, subprocess.SubprocessError, trial.Stuck) as error:
        check.expect(False, f"the check broke off: {type(error).__name__}: {error}")
    check.end()
    systemctl("poweroff", "--force", "--force")


if __name__ == "__main__":
    main()
