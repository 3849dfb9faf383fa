"""One way to end the controller or the guard while the crane swings, and what the valves and systemd did about it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from can_dbc.messages.crane import OperatorAction
from host.service_lab.pilot import Pilot, Valve
from host.systemd import show
from machine.status.modes import Mode

CONTROLLER: Final = "timberhand-controller.service"
GUARD: Final = "timberhand-guard.service"
OPEN_PCT: Final = 25.0
"""The crane swings when a spool is open so far."""
SHUT_PCT: Final = 1.0
MOVING: Final = (1, 2)
"""ValveFbA.State in which the valve node gives the spools a command: active, and its own ramp."""
COMMAND_PRIORITY: Final = 40
TICK_NS: Final = 5_000_000
QUIET_S: Final = 1.5
"""So long a machine whose service came back is watched."""
STILL_MS: Final = 10.0
"""A guest that stood still for longer near the end of the service proves nothing."""
GUARD_BACK_NS: Final = 400_000_000
"""What the guard says later than this after its end, it says in its next life (RestartSec is longer)."""
PATIENCE_S: Final = 120.0
"""A busy host stops the machine now and then, and it is armed again for so long."""
BUTTONS: Final = {Mode.FAULT: OperatorAction.RESET, Mode.STOP: OperatorAction.ARM, Mode.STANDBY: OperatorAction.ARM}


@dataclass(frozen=True, slots=True)
class Way:
    """How a service is ended: by a signal, or with 0 by systemd."""

    name: str
    unit: str
    signal: int


WAYS: Final = (
    Way("kill", CONTROLLER, signal.SIGKILL),
    Way("hang", CONTROLLER, signal.SIGSTOP),
    Way("stop", CONTROLLER, 0),
    Way("guard_kill", GUARD, signal.SIGKILL),
    Way("guard_hang", GUARD, signal.SIGSTOP),
)


class Stuck(Exception):
    """The machine does not do what a trial needs; the message says what."""


def swinging(pilot: Pilot) -> None:
    """Arm the machine and swing it, as a human and a planner would, again after every stop; raises `Stuck`."""
    limit_s = time.monotonic() + PATIENCE_S
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
    raise Stuck(f"the crane does not swing: {pilot.report}")


def _fast(pilot: Pilot) -> bool:
    return pilot.opening_pct() > OPEN_PCT


def _halted(pilot: Pilot) -> bool:
    return pilot.report is None or pilot.report.mode != Mode.ACTIVE


def end(way: Way, pilot: Pilot) -> dict[str, Any]:
    """Figures of one trial; times in ms from the moment the service was ended."""
    before = show(way.unit, "NRestarts", "MainPID")  # takes its time: nothing is asked while the crane swings
    controller = show(CONTROLLER, "MainPID")["MainPID"]
    pid = int(before["MainPID"])
    ended = os.pidfd_open(pid)
    stop = None if way.signal else prepared("systemctl", "stop", way.unit)
    swinging(pilot)
    opening_pct = pilot.opening_pct()
    pilot.forget()
    began_ns = time.monotonic_ns()
    if stop:
        go(stop)
    else:
        signal.pidfd_send_signal(ended, way.signal)
    gone = pilot.until(lambda: select.select([ended], [], [], 0)[0], 10.0)
    gone_ns = time.monotonic_ns()
    os.close(ended)
    pilot.until(lambda: False, 0.5)
    if stop:
        stop.wait()
        # The signal came at most a tick before the last words; asking systemd to send it took longer than all the rest.
        began_ns = pilot.farewell_ns - TICK_NS
        opening_pct = max((v.opening_pct for v in pilot.valves if v.stamp_ns <= began_ns), default=0.0)
    figures: dict[str, Any] = {
        "way": way.name,
        "moving_until_then": not stop or pilot.mode_at_farewell is Mode.ACTIVE,
        "opening_pct": opening_pct,
        "ended_ms": (gone_ns - began_ns) * 1e-6 if gone else None,
        "neutral_ms": _after(pilot, began_ns, lambda v: v.state in MOVING),
        "no_flow_ms": _after(pilot, began_ns, lambda v: v.opening_pct > pilot.deadband_pct),
        "shut_ms": _after(pilot, began_ns, lambda v: v.opening_pct > SHUT_PCT),
        "stood_still_ms": pilot.stood_still_ms(began_ns - 10_000_000, began_ns + 200_000_000),
        "feedback": [
            (round((v.stamp_ns - began_ns) * 1e-6, 1), v.state, round(v.opening_pct, 1))
            for v in pilot.valves
            if -20_000_000 < v.stamp_ns - began_ns < 250_000_000
        ],
    }
    if stop:
        pilot.rest()
        figures |= {"state": show(way.unit, "ActiveState")["ActiveState"], "frames_when_stopped": _frames(pilot)}
        subprocess.run(["systemctl", "start", way.unit], check=True)
        pilot.report = None
        pilot.until(lambda: pilot.report, 5.0)
        return figures
    figures |= _second_life(way.unit, pilot, pid, int(before["NRestarts"]), began_ns)
    figures["same_controller"] = show(CONTROLLER, "MainPID")["MainPID"] == controller
    pilot.rest()
    return figures


def prepared(*command: str) -> subprocess.Popen[bytes]:
    """A command that waits for `go`: to start it then would hold the pilot up, and it must not wait behind others."""
    waiting = subprocess.Popen(["sh", "-c", 'read line; exec "$@"', "sh", *command], stdin=subprocess.PIPE)
    os.sched_setscheduler(waiting.pid, os.SCHED_FIFO, os.sched_param(COMMAND_PRIORITY))
    return waiting


def go(command: subprocess.Popen[bytes]) -> None:
    """Let it run."""
    assert command.stdin
    os.write(command.stdin.fileno(), b"\n")


def moving(figures: dict[str, Any]) -> bool:
    """Whether the crane swung until the end, so that the trial says something."""
    return bool(figures["moving_until_then"] and figures["opening_pct"] > OPEN_PCT)


def disturbed(figures: dict[str, Any]) -> bool:
    """Whether the guest stood still while it mattered."""
    return bool(figures["stood_still_ms"] > STILL_MS)


def _after(pilot: Pilot, began_ns: int, moving: Callable[[Valve], bool]) -> float:
    """From ``began_ns`` to the first feedback after which nothing moves any more."""
    last_ns = max((v.stamp_ns for v in pilot.valves if moving(v)), default=began_ns)
    return next((max(v.stamp_ns - began_ns, 0) * 1e-6 for v in pilot.valves if v.stamp_ns > last_ns), float("inf"))


def _frames(pilot: Pilot) -> int:
    pilot.forget()
    pilot.until(lambda: False, 0.3)
    return pilot.commands


def _second_life(unit: str, pilot: Pilot, pid: int, restarts: int, began_ns: int) -> dict[str, Any]:
    """It comes back by itself, the machine disarmed, and stays so whatever setpoints come."""
    pilot.report = None
    pilot.until(lambda: pilot.report and pilot.guarded_ns > began_ns + GUARD_BACK_NS, 15.0)
    figures = quiet(pilot)
    after = show(unit, "NRestarts", "ActiveState", "StatusText", "ActiveEnterTimestampMonotonic", "MainPID")
    return figures | {
        "back_ms": int(after["ActiveEnterTimestampMonotonic"]) * 1e-3 - began_ns * 1e-6,
        "restarts": int(after["NRestarts"]) - restarts,
        "another": int(after["MainPID"]) not in (0, pid),
        "state": after["ActiveState"],
        "status": after["StatusText"],
    }


def quiet(pilot: Pilot) -> dict[str, Any]:
    """What the machine does while nobody presses a button."""
    pilot.forget()
    pilot.until(lambda: False, QUIET_S)
    return {
        "modes_after": sorted(mode.name for mode in pilot.modes),
        "armed_after": pilot.armed_after_ns > 0,
        "opening_after_pct": max((v.opening_pct for v in pilot.valves), default=0.0),
        "frames_after": pilot.commands,
    }


def idle(figures: dict[str, Any]) -> bool:
    """Whether the machine waited for a human in `quiet`."""
    armed = figures["armed_after"] or {"ARMED", "ACTIVE"} & set(figures["modes_after"])
    return not armed and figures["opening_after_pct"] <= SHUT_PCT
