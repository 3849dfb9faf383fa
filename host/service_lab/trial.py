"""Ends the controller or the guard while the crane slews, and measures how valves and systemd react."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from can_dbc.messages.crane import OperatorAction
from host.service_lab.pilot import Pilot, Valve
from host.systemd import show
from host.vcan_lab.spec import LabError
from machine.joints import Joint
from machine.status.modes import Mode

CONTROLLER: Final = "timberhand-controller.service"
GUARD: Final = "timberhand-guard.service"
OPEN_PCT: Final = 25.0
"""The crane moves when a spool opens this far."""
SHUT_PCT: Final = 1.0
MOVING: Final = (1, 2)
"""ValveFbA.State in which the valve node commands its spools: active, and its own ramp."""
COMMAND_PRIORITY: Final = 40
TICK_NS: Final = 5_000_000
QUIET_S: Final = 1.5
"""Observation time after a service has returned."""
GUARD_BACK_NS: Final = 400_000_000
"""Messages of the guard later than this after its end come from the restarted guard (RestartSec is longer)."""
REARM_S: Final = 120.0
"""A busy host may stop the machine; for this time it is armed again."""
BUTTONS: Final = {Mode.FAULT: OperatorAction.RESET, Mode.STOP: OperatorAction.ARM, Mode.STANDBY: OperatorAction.ARM}


@dataclass(frozen=True, slots=True)
class Ending:
    """How a service is ended: by a signal, or by systemd when ``signal`` is 0."""

    name: str
    unit: str
    signal: int


ENDINGS: Final = (
    Ending("kill", CONTROLLER, signal.SIGKILL),
    Ending("hang", CONTROLLER, signal.SIGSTOP),
    Ending("stop", CONTROLLER, 0),
    Ending("guard_kill", GUARD, signal.SIGKILL),
    Ending("guard_hang", GUARD, signal.SIGSTOP),
)


def slew_until_fast(pilot: Pilot) -> None:
    """Arm the machine and slew it, again after every stop.

    Raises:
        LabError: the crane does not move.
    """
    limit_s = time.monotonic() + REARM_S
    while time.monotonic() < limit_s:
        mode = Mode(pilot.report.mode) if pilot.report else Mode.BOOT
        if mode in BUTTONS:
            pilot.rest()
            pilot.press(BUTTONS[mode])
            pilot.until(lambda: pilot.report and pilot.report.mode == Mode.ARMED, 0.6)
        elif mode is Mode.ARMED:
            pilot.swing()
            pilot.until(lambda: pilot.report and pilot.report.mode == Mode.ACTIVE, 0.6)
        elif mode is Mode.ACTIVE:
            pilot.until(lambda: _fast(pilot) or _halted(pilot), 5.0)
            pilot.until(lambda: _halted(pilot), 0.3)
            if _fast(pilot) and not _halted(pilot):
                return
        else:
            pilot.until(lambda: False, 0.6)
    raise LabError("service-lab.machine-stuck", f"the crane does not move: {pilot.report}")


def _fast(pilot: Pilot) -> bool:
    return pilot.opening_pct() > OPEN_PCT


def _halted(pilot: Pilot) -> bool:
    return pilot.report is None or pilot.report.mode != Mode.ACTIVE


def run_trial(ending: Ending, pilot: Pilot) -> dict[str, Any]:
    """Run one trial and return its figures; times in ms from the end of the service."""
    before = show(ending.unit, "NRestarts", "MainPID")  # slow, so not while the crane moves
    controller = show(CONTROLLER, "MainPID")["MainPID"]
    pid = int(before["MainPID"])
    ended = os.pidfd_open(pid)
    stop = None if ending.signal else prepare("systemctl", "stop", ending.unit)
    slew_until_fast(pilot)
    opening_pct = pilot.opening_pct()
    pilot.clear()
    pilot.until(lambda: pilot.valves, 0.1)
    began_ns = time.monotonic_ns()
    if stop:
        release(stop)
    else:
        signal.pidfd_send_signal(ended, ending.signal)
    gone = pilot.until(lambda: select.select([ended], [], [], 0)[0], 10.0)
    gone_ns = time.monotonic_ns()
    os.close(ended)
    pilot.until(lambda: False, 0.5)
    if stop:
        stop.wait()
        # The signal came at most a tick before the last frames; systemd took longer than that to send it.
        began_ns = pilot.disarmed_ns - TICK_NS
        opening_pct = max((v.opening_pct for v in pilot.valves if v.stamp_ns <= began_ns), default=opening_pct)
    figures: dict[str, Any] = {
        "way": ending.name,
        "moving_until_then": not stop or pilot.mode_when_disarmed is Mode.ACTIVE,
        "opening_pct": opening_pct,
        "ended_ms": (gone_ns - began_ns) * 1e-6 if gone else None,
        "neutral_ms": time_after(pilot, began_ns, lambda v: v.state in MOVING),
        "no_flow_ms": time_after(pilot, began_ns, lambda v: v.opening_pct > pilot.deadband_pct),
        "shut_ms": time_after(pilot, began_ns, lambda v: v.opening_pct > SHUT_PCT),
        "feedback": [
            (round((v.stamp_ns - began_ns) * 1e-6, 1), v.state, round(v.opening_pct, 1))
            for v in pilot.valves
            if -20_000_000 < v.stamp_ns - began_ns < 250_000_000
        ],
    }
    if stop:
        pilot.rest()
        figures |= {"state": show(ending.unit, "ActiveState")["ActiveState"], "frames_when_stopped": _frames(pilot)}
        subprocess.run(["systemctl", "start", ending.unit], check=True)
        pilot.report = None
        pilot.until(lambda: pilot.report, 5.0)
        return figures
    figures |= _after_restart(ending.unit, pilot, pid, int(before["NRestarts"]), began_ns)
    figures["same_controller"] = show(CONTROLLER, "MainPID")["MainPID"] == controller
    pilot.rest()
    return figures


def prepare(*command: str) -> subprocess.Popen[bytes]:
    """Start a command that waits for `release`, so that its start delays neither the pilot nor itself."""
    waiting = subprocess.Popen(["sh", "-c", 'read line; exec "$@"', "sh", *command], stdin=subprocess.PIPE)
    os.sched_setscheduler(waiting.pid, os.SCHED_FIFO, os.sched_param(COMMAND_PRIORITY))
    return waiting


def release(command: subprocess.Popen[bytes]) -> None:
    """Let a prepared command run."""
    assert command.stdin
    os.write(command.stdin.fileno(), b"\n")


def was_moving(figures: dict[str, Any]) -> bool:
    """Tell whether the crane moved until the end of the service, so that the trial is valid."""
    return bool(figures["moving_until_then"] and figures["opening_pct"] > OPEN_PCT)


def time_after(pilot: Pilot, began_ns: int, moving: Callable[[Valve], bool]) -> float:
    """Compute the time from ``began_ns`` to the first feedback after the last motion [ms]."""
    last_ns = max((v.stamp_ns for v in pilot.valves if moving(v)), default=began_ns)
    return next((max(v.stamp_ns - began_ns, 0) * 1e-6 for v in pilot.valves if v.stamp_ns > last_ns), float("inf"))


def _frames(pilot: Pilot) -> int:
    pilot.clear()
    pilot.until(lambda: False, 0.3)
    return pilot.commands


def _after_restart(unit: str, pilot: Pilot, pid: int, restarts: int, began_ns: int) -> dict[str, Any]:
    """Measure after the restart: the service returns, the machine stays disarmed despite setpoints."""
    pilot.report = None
    pilot.until(lambda: pilot.report and pilot.guarded_ns > began_ns + GUARD_BACK_NS, 15.0)
    figures = observe_idle(pilot)
    after = show(unit, "NRestarts", "ActiveState", "StatusText", "ActiveEnterTimestampMonotonic", "MainPID")
    return figures | {
        "back_ms": int(after["ActiveEnterTimestampMonotonic"]) * 1e-3 - began_ns * 1e-6,
        "restarts": int(after["NRestarts"]) - restarts,
        "another": int(after["MainPID"]) not in (0, pid),
        "state": after["ActiveState"],
        "status": after["StatusText"],
    }


def observe_idle(pilot: Pilot) -> dict[str, Any]:
    """Observe the machine without pressing a button."""
    pilot.clear()
    pilot.until(lambda: False, QUIET_S)
    return {
        "modes_after": sorted(mode.name for mode in pilot.modes),
        "armed_after": pilot.armed_after_ns > 0,
        "opening_after_pct": max((v.opening_pct for v in pilot.valves), default=0.0),
        "frames_after": pilot.commands,
    }


def is_idle(figures: dict[str, Any]) -> bool:
    """Tell whether the machine waited for an operator during `observe_idle`."""
    armed = figures["armed_after"] or {"ARMED", "ACTIVE"} & set(figures["modes_after"])
    return not armed and figures["opening_after_pct"] <= SHUT_PCT


# -- Loss of the crane's bus while the crane moves: the interface goes down, or the adapter is unplugged, and returns.
#
# The bus shows nothing meanwhile, so the emulated machine is asked for its motion.

INTERFACE: Final = "crane0"
AWAY_S: Final = 2.0
STOPPED_S: Final = 0.5
"""Time for the boom to come to rest after its valves have closed."""
BACK_S: Final = 15.0


@dataclass(frozen=True, slots=True)
class Loss:
    """The commands that remove and restore the interface; the installed udev rule sets up a new adapter."""

    name: str
    lose: tuple[str, ...]
    restore: tuple[str, ...]


LOSSES: Final = (
    Loss("down", ("ip", "link", "set", INTERFACE, "down"), ("ip", "link", "set", INTERFACE, "up")),
    Loss("unplugged", ("ip", "link", "del", INTERFACE), ("ip", "link", "add", INTERFACE, "type", "vcan")),
)


def lose(loss: Loss, pilot: Pilot, plant_port: int) -> dict[str, Any]:
    """Run one trial and return its figures.

    Raises:
        LabError: the crane does not move before or after the loss.
    """
    processes = _processes()
    losing = prepare(*loss.lose)
    slew_until_fast(pilot)
    opening_pct = pilot.opening_pct()
    release(losing)
    losing.wait()
    pilot.until(lambda: False, STOPPED_S)
    stopped_rad = ask_plant(plant_port, "state")["joints"][Joint.SLEW]
    pilot.until(lambda: False, AWAY_S)
    status = {unit: show(unit, "StatusText")["StatusText"] for unit in (CONTROLLER, GUARD)}
    moved_rad = abs(ask_plant(plant_port, "state")["joints"][Joint.SLEW] - stopped_rad)
    pilot.clear()
    begin_s = time.monotonic()
    subprocess.run(loss.restore, check=True)
    back = pilot.until(lambda: pilot.valves and pilot.guarded_ns and pilot.commands, BACK_S)
    back_s = time.monotonic() - begin_s
    figures = observe_idle(pilot)
    same = _processes() == processes
    if back:
        slew_until_fast(pilot)
        pilot.rest()
    return figures | {
        "way": loss.name,
        "opening_pct": opening_pct,
        "moved_mrad": moved_rad * 1e3,
        "status": status,
        "back_s": back_s if back else None,
        "same_processes": same,
    }


def _processes() -> list[dict[str, str]]:
    return [show(unit, "MainPID", "NRestarts", "ActiveState") for unit in (CONTROLLER, GUARD)]


def ask_plant(port: int, question: str) -> dict[str, Any]:
    """Ask the emulated machine (``python -m sim``); return its answer, with joints in rad and m."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5.0)
        client.sendto(json.dumps({"op": question}).encode(), ("127.0.0.1", port))
        answer: dict[str, Any] = json.loads(client.recv(65536))
        return answer
