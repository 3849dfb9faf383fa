"""The timing stand: the real controller and guard, as processes on a real-time bus, with a light machine around them.

Wire (or vcan), rig, guard, controller and planner are started, the machine is armed and moves when `Stand.start`
returns.  The controller has one processor to itself where there are two, so that what runs beside it is what we put
there.  Everything ends with the context, neutral commands first.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from can_dbc.bus.base import VCAN_NAMES
from can_dbc.timing.page import Timing, TimingRefused, read_timing
from hil.harness.processes import Family, free_udp_ports
from host.exit_codes import CommandFailed, ExitCode
from machine.load import load_profile
from machine.reasons import Reason

HOST: Final = "127.0.0.1"
BITRATES: Final = {"crane0": 1_000_000, "mach0": 250_000}
PRIORITY: Final = {"wire": 60, "rig": 50, "planner": 30, "witness": 20}
HARNESS_PRIORITY: Final = 10
"""SCHED_FIFO: emulated hardware answers like hardware, and planner and witness are not what is measured."""
END_ORDER: Final = ("planner", "controller", "guard", "witness", "rig", "wire")
START_S: Final = 60.0
ACTIVE_S: Final = 60.0
HELPER_ENDS_S: Final = 60.0
MEMORY: Final = Path("/dev/shm")
"""The timing page must lie in memory: writing to a page of a disk file can fault and wait for the disk."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One stand: profile, rate, period of the PLC, bus, bit rates, core of the controller, further arguments for it."""

    profile: str
    rate_hz: int
    bus: str = "wire"
    bitrates: tuple[tuple[str, int], ...] = tuple(BITRATES.items())
    arguments: tuple[str, ...] = ()

    @property
    def period_ns(self) -> int:
        """The controller's."""
        return 1_000_000_000 // self.rate_hz


def cores() -> tuple[int, set[int]]:
    """The controller's processor, and those of everything else (the same one where there is but one)."""
    available = sorted(os.sched_getaffinity(0))
    return available[-1], set(available[:-1]) or {available[-1]}


class Stand:
    """A running stand; ``helpers`` are what runs beside it for a while (`experiments.timing.reference_loops`).

    ``said`` is the newest that each process said of itself, ``modes`` every change of mode, ``halts`` why it stopped.
    """

    def __init__(self, setting: Setting, directory: Path) -> None:
        self.setting = setting
        self.cpu, self.others = cores()
        self.said: dict[str, dict[str, Any]] = {}
        self.modes: list[str] = []
        self.halts: set[Reason] = set()
        directory.mkdir(parents=True, exist_ok=True)
        where = MEMORY if MEMORY.is_dir() else None
        self._private = Path(tempfile.mkdtemp(prefix="timberhand-timing-", dir=where))
        self.page = self._private / "controller.process.timing"
        self.family = Family(directory, environment={"TIMBERHAND_WIRE_DIR": str(self._private)})
        self.helpers = Family(directory, own_sessions=False)

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Put everything up until the machine moves; the harness itself runs above what loads the host.

        Raises:
            CommandFailed: a process does not start, or the machine does not become ACTIVE.
        """
        with contextlib.suppress(OSError):  # without the right the windows are merely less sharp
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(HARNESS_PRIORITY))
        s = self.setting
        profile = load_profile(s.profile)
        names = [b for b in (profile.crane_bus, profile.machine_bus) if b]
        vcan = s.bus == "vcan"
        addresses = {n: f"socketcan:{VCAN_NAMES[n]}" if vcan else f"wire:{n}" for n in names}
        buses = [x for n, address in addresses.items() for x in ("--bus", f"{n}={address}")]
        crane = ("--bus", f"{profile.crane_bus}={addresses[profile.crane_bus]}")
        control, reports, ticks = free_udp_ports(3)
        if not vcan:
            rates = dict(s.bitrates)
            self._start("wire", "hil.wire.daemon", *(x for n in names for x in ("--bus", f"{n}:{rates[n]}")))
        cycle_us = min(5000, s.period_ns // 1000)
        self._start("rig", "experiments.timing.emulated_machine", "--profile", s.profile, *buses, "--cycle-us", cycle_us)
        self._start(
            "planner", "experiments.timing.setpoint_source", "--profile", s.profile,
            "--controller", f"{HOST}:{control}", "--report-port", reports,
        )  # fmt: skip
        self._start(
            "witness", "experiments.timing.bus_observer", "--profile", s.profile, "--rate", s.rate_hz, "--port", ticks
        )
        guard = self.family.start("guard", "controller.guard", "--profile", s.profile, *crane)
        self._elsewhere(guard.process.pid)
        self.family.start(
            "controller", "controller", "--profile", s.profile, *buses, "--setpoint-port", control,
            "--report", f"{HOST}:{reports}", "--record", f"{HOST}:{ticks}", "--rate", s.rate_hz, "--timing", self.page,
            *(("--cpu", self.cpu) if self.cpu not in self.others else ()), *s.arguments,
        )  # fmt: skip
        self._await_motion()

    def _start(self, name: str, module: str, *arguments: object) -> None:
        child = self.family.start(name, module, *arguments)
        self.family.await_message(name, "ready", START_S)
        self.family.hasten(name, PRIORITY[name])
        self._elsewhere(child.process.pid)

    def _elsewhere(self, pid: int) -> None:
        os.sched_setaffinity(pid, self.others)

    def _await_motion(self) -> None:
        limit = time.monotonic() + ACTIVE_S
        while self.mode != "ACTIVE" or not self.page.exists():
            self.look()
            if time.monotonic() > limit:
                why = self.said.get("planner", {})
                raise CommandFailed(ExitCode.SAFETY_STOP, f"the machine does not move on the timing stand: {why or 'no report'}")
            time.sleep(0.05)

    def look(self) -> None:
        """Take in what the processes have said.

        Raises:
            CommandFailed: one of them has ended.
        """
        gone = self.family.dead()
        for name, message in self.family.messages():
            self.said[name] = self.said.get(name, {}) | message
            if name == "planner" and message.get("event") == "mode":
                self.modes.append(f"{message['mode']}: {message['why']}")
                if message["mode"] in ("STOP", "FAULT"):
                    self.halts.add(Reason(message["reason"]))
        if gone is not None:
            code = gone.process.returncode
            known = ExitCode(code) if code in set(ExitCode) and code else ExitCode.SAFETY_STOP
            raise CommandFailed(known, f"{gone.name} ended on the timing stand: {gone.complaint()}")

    @property
    def mode(self) -> str:
        """The controller's mode as last reported."""
        return str(self.said.get("planner", {}).get("mode", ""))

    @property
    def stops(self) -> int:
        """Stops since the start."""
        return int(self.said.get("planner", {}).get("stops", 0))

    @property
    def stamp_ns(self) -> int:
        """Nominal time of one of the controller's ticks."""
        return int(self.said["planner"]["stamp_ns"])

    def timing(self) -> Timing:
        """The controller's page now; raises CommandFailed when there is none."""
        try:
            return read_timing(self.page)
        except TimingRefused as error:
            raise CommandFailed(ExitCode.CONFIGURATION, str(error)) from None

    def fresh_timing(self) -> Timing:
        """The next page that the controller writes (it does so once a second)."""
        before = self.timing().facts.written_ns
        limit = time.monotonic() + 5.0
        while (now := self.timing()).facts.written_ns == before:
            self.look()
            if time.monotonic() > limit:
                raise CommandFailed(ExitCode.SAFETY_STOP, "the controller has stopped writing its timing page")
            time.sleep(0.02)
        return now

    def wait(self, seconds: float, tell: Callable[[float], None] = lambda _share: None) -> None:
        """Let it run, looking after it; ``tell`` hears the share that is over."""
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < seconds:
            self.look()
            tell(passed / seconds)
            time.sleep(min(0.1, seconds - passed))

    def await_end(self, name: str, seconds: float) -> dict[str, Any]:
        """Wait until a helper has ended by itself; what it said.

        Raises:
            CommandFailed: it fails or does not end, or the stand breaks down meanwhile.
        """
        child = self.helpers.children[name]
        limit = time.monotonic() + seconds
        said: dict[str, Any] = {}
        while True:
            ended = child.process.poll() is not None
            for who, message in self.helpers.messages():
                said |= message if who == name else {}
            if ended:
                break
            if time.monotonic() > limit:
                raise CommandFailed(ExitCode.CONFIGURATION, f"{name} does not end; see {child.errors}")
            self.look()
            time.sleep(0.05)
        self.end_helper(name)
        return said

    def end_helper(self, name: str) -> None:
        """End a helper that writes its findings when it is told to stop; raises CommandFailed when it has failed."""
        complaint = self.helpers.children[name].complaint
        if code := self.helpers.stop(name, HELPER_ENDS_S):
            raise CommandFailed(ExitCode.CONFIGURATION, f"{name} failed with exit code {code}: {complaint()}")

    def close(self) -> None:
        """End everything, neutral commands first."""
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        self.helpers.stop_all(())
        self.family.stop_all(END_ORDER)
        shutil.rmtree(self._private, ignore_errors=True)
