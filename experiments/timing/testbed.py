"""The timing testbed: the real controller and guard as processes on a real-time bus, with an emulated machine.

`TimingTestbed.start` starts bus, emulated machine, guard, controller and setpoint source, and returns when the machine
is armed and moves.  The controller has one processor to itself if there are two, so that only the chosen load runs
beside it.  Everything ends with the context, neutral commands first.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Self

from can_dbc.bus.factory import VCAN_NAMES
from can_dbc.messages.envelope import write_key
from can_dbc.messages.operator_link import guard_path
from can_dbc.timing.durations import Durations
from can_dbc.timing.page import Facts, Timing, read_timing
from experiments.common import host_activity
from experiments.timing.events import Events, Stall, losses_between, stop
from hil.harness.processes import ProcessGroup, free_udp_ports
from hil.tick.instructions import INSTRUCTIONS, count, open_counter
from hil.wire.core import BITRATES
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile
from machine.status.modes import STOPPED
from machine.status.reasons import Reason
from runtime.errors import InputRefused

HOST: Final = "127.0.0.1"
STAND_INS: Final = "experiments.timing.stand_ins"
PRIORITY: Final = {"wire": 60, "machine": 50, "setpoints": 30, "witness": 90, "witness-controller": 79}
OBSERVER_NICENESS: Final = -20
HARNESS_PRIORITY: Final = 10
"""SCHED_FIFO: emulated hardware must answer like hardware; setpoint source and observer are not measured."""
BUS_CORE: Final = ("wire", "machine", "setpoints", "guard", "witness")
"""Real-time processes that share one processor; beyond 95 % of it Linux gives 50 ms of every second to others."""
WITNESS_US: Final = {"witness": 1000, "witness-controller": 2000}
"""Longest periods of the witnesses, at most the controller's: a stall is seen shorter by up to one period.  Beside the
controller the witness wakes below it and less often, so that it does not disturb it."""
END_ORDER: Final = ("setpoints", "controller", "guard", "observer", "machine", "wire")
WAIT_S: Final = 60.0
"""For a process to start or to end, and for the machine to move."""
PAGE_S: Final = 5.0
_STOPPED: Final = tuple(mode.name for mode in STOPPED)
MEMORY: Final = Path("/dev/shm")  # only mkdtemp makes names in it  # nosec B108
"""The timing page lies in memory: a write to a page of a disk file can fault and wait for the disk."""


@dataclass(frozen=True, slots=True)
class TestbedConfig:
    """Profile, rate, bus, bit rates, and further ports that hear the controller's reports."""

    profile: str
    rate_hz: int
    bus: str = "wire"
    bitrates: tuple[tuple[str, int], ...] = tuple(BITRATES.items())
    report_ports: tuple[int, ...] = ()

    @property
    def period_ns(self) -> int:
        """Period of the controller [ns]."""
        return 1_000_000_000 // self.rate_hz


Mark = tuple[Timing, int | None]
"""The beginning of a `Span`: the controller's timing page, and its instructions so far."""


@dataclass(frozen=True, slots=True)
class Span:
    """What the controller did between two of its timing pages: totals, histograms of the time between, instructions
    (None: not counted on this host)."""

    begin: Facts
    end: Facts
    durations: dict[str, Durations]
    instructions: int | None

    @property
    def ticks(self) -> int:
        """Ticks executed."""
        return self.end.ticks - self.begin.ticks

    @property
    def missed(self) -> int:
        """Periods skipped."""
        return self.end.missed - self.begin.missed

    @property
    def cpu_ns(self) -> int:
        """Processor time of the whole process."""
        return self.end.process.cpu_ns - self.begin.process.cpu_ns

    @property
    def load(self) -> dict[str, float]:
        """Share of a processor that the controller used, and its frames per second, both directions."""
        seconds = (self.end.written_ns - self.begin.written_ns) * 1e-9
        frames = [sum(b.received + b.sent for b in facts.buses) for facts in (self.begin, self.end)]
        return {"cpu_share": self.cpu_ns * 1e-9 / seconds, "frames_per_s": (frames[1] - frames[0]) / seconds}


def cores() -> tuple[int, set[int]]:
    """Choose the controller's processor, and those of everything else (the same one if there is only one)."""
    available = sorted(os.sched_getaffinity(0))
    return available[-1], set(available[:-1]) or {available[-1]}


class TimingTestbed:
    """A running testbed.

    ``helpers`` are processes that run beside it for a while.  ``status`` holds the newest message of each process, and
    ``events`` what was lost, stopped or stalled.  Where a method waits, CommandFailed says that a process has ended.
    """

    def __init__(self, setting: TestbedConfig, directory: Path) -> None:
        self.setting = setting
        self.cpu, self.others = cores()
        self.status: dict[str, dict[str, Any]] = {}
        self.events = Events()
        self._last: Timing | None = None
        self._was = ""
        self._cpu_s: list[tuple[float, float]] = []
        self._counter: int | None = None
        directory.mkdir(parents=True, exist_ok=True)
        where = MEMORY if MEMORY.is_dir() else None
        self._private = Path(tempfile.mkdtemp(prefix="timberhand-timing-", dir=where))
        self.page, self.key_file = self._private / "controller.timing", self._private / "key"
        self._operators = self._private / "controller.operator"
        self.family = ProcessGroup(directory, environment={"TIMBERHAND_WIRE_DIR": str(self._private)})
        self.helpers = ProcessGroup(directory, own_sessions=False)

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
        """Start everything and wait until the machine moves; the harness itself runs above the load of the host."""
        with contextlib.suppress(OSError):  # without the privilege the window edges are less precise
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(HARNESS_PRIORITY))
        s, profile = self.setting, load_profile(self.setting.profile)
        names = [b for b in (profile.crane_bus, profile.machine_bus) if b]
        vcan, rates, cycle_us = s.bus == "vcan", dict(s.bitrates), min(5000, s.period_ns // 1000)
        control, reports = free_udp_ports(2)
        ticks, key = self._private / "controller.ticks", write_key(self.key_file)
        own_cpu = None if self.cpu in self.others else self.cpu
        if not vcan:
            self._start("wire", "hil.wire.daemon", bus=[f"{n}:{rates[n]}" for n in names])
        for name, cpu in (("witness", min(self.others)), ("witness-controller", own_cpu)):
            if cpu is not None:
                self._start(name, "experiments.common.stall_witness", period_us=min(WITNESS_US[name], cycle_us))
                os.sched_setaffinity(self.family.children[name].process.pid, {cpu})
        common: dict[str, object] = {
            "profile": s.profile,
            "bus": [f"{n}=" + (f"socketcan:{VCAN_NAMES[n]}" if vcan else f"wire:{n}") for n in names],
            "rate": s.rate_hz,
            "operator": self._operators,
        }
        self._start("machine", STAND_INS, "machine", **common, cycle_us=cycle_us)
        to = f"{HOST}:{control}"
        self._start("setpoints", STAND_INS, "setpoints", **common, controller=to, report_port=reports, key_file=key)
        self._start("observer", STAND_INS, "observer", **common, ticks=ticks)
        guard = self.family.start("guard", "controller.guard", **common, state=self.page.with_suffix(".latched"))
        os.sched_setaffinity(guard.process.pid, self.others)
        controller = self.family.start(
            "controller",
            "controller",
            **common,
            setpoint_port=control,
            report=[f"{HOST}:{port}" for port in (reports, *s.report_ports)],
            record=ticks,
            timing=self.page,
            key_file=key,
            cpu=own_cpu,
        )
        self._counter = open_counter(controller.process.pid, INSTRUCTIONS)
        if not self.until(lambda: self.mode == "ACTIVE" and self.page.exists(), WAIT_S):
            raise CommandFailed(
                "timing-testbed.not-moving",
                f"the machine does not move on the timing testbed: {self.status.get('setpoints', 'no report')}",
                ExitCode.SAFETY_STOP,
            )

    def _start(self, name: str, module: str, *words: object, **options: object) -> None:
        child = self.family.start(name, module, *words, **options)
        self.family.await_message(name, "ready", WAIT_S)
        if name in PRIORITY:
            self.family.set_fifo_priority(name, PRIORITY[name])
        else:  # it only reads what the ring holds for seconds
            self.family.set_niceness(name, OBSERVER_NICENESS)
        os.sched_setaffinity(child.process.pid, self.others)

    def poll(self) -> None:
        """Read the messages of all processes."""
        gone = self.family.dead()
        now_s = time.monotonic()
        if not self._cpu_s or now_s - self._cpu_s[-1][0] >= 0.5:
            used = (host_activity.cpu_s(c.process.pid) for n, c in self.family.children.items() if n in BUS_CORE)
            self._cpu_s = [*self._cpu_s[-6:], (now_s, sum(used))]
        for name, message in self.family.messages():
            self.status[name] = self.status.get(name, {}) | message
            if "stall_ns" in message:
                shared = name == "witness"
                stall = Stall(
                    min(self.others) if shared else self.cpu,
                    message["end_ns"],
                    message["stall_ns"],
                    self._own_share() if shared else 0.0,
                )
                self.events.stalls.append(stall)
            if name == "setpoints" and message.get("event") == "mode":
                if message["mode"] in _STOPPED and self._was not in _STOPPED:
                    self.events.stops.append(stop(message["stamp_ns"], Reason(message["reason"]), message["why"]))
                self._was = message["mode"]
        if gone is not None:
            code = gone.process.returncode
            known = ExitCode(code) if code in set(ExitCode) and code else ExitCode.SAFETY_STOP
            raise CommandFailed(
                "timing-testbed.process-ended", f"{gone.name} ended on the timing testbed: {gone.complaint()}", known
            )

    def _own_share(self) -> float:
        """Compute the share of their processor used by the processes of `BUS_CORE`: the largest of the last seconds."""
        return max(((b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(self._cpu_s)), default=0.0)

    @property
    def mode(self) -> str:
        """The mode that the controller last reported."""
        return str(self.status.get("setpoints", {}).get("mode", ""))

    @property
    def stamp_ns(self) -> int:
        """Nominal time of one of the controller's ticks [ns]."""
        return int(self.status["setpoints"]["stamp_ns"])

    def counters(self) -> Counter[str]:
        """Return the counts of observer and emulated machine so far; a machine alone on its bus has frames refused."""
        observed, rig = (Counter(self.status.get(name, {})) for name in ("observer", "machine"))
        return Counter(
            {
                **{name: observed[name] for name in ("received", "sent", "gaps", "unanswered")},
                "damaged": observed["damaged"] + rig["damaged"],
                "gaps_rig": rig["gaps"],
                "records_lost": observed["records_lost"] + observed["records_unreadable"],
                "machine_frames_lost": rig["refused_frames"] + rig["dropped_frames"],
                "machine_stalls": rig["stalls"],
            }
        )

    def timing(self) -> Timing:
        """Read the controller's timing page now, its losses noted; raises CommandFailed when there is none."""
        try:
            now = read_timing(self.page)
        except InputRefused as error:
            raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
        if self._last is not None:
            self.events.losses.extend(losses_between(self._last.facts, now.facts))
        self._last = now
        return now

    def fresh_timing(self) -> Timing:
        """Wait for the next timing page that the controller writes; it writes one per second."""
        before_ns = self.timing().facts.written_ns
        if not self.until(lambda: self.timing().facts.written_ns != before_ns, PAGE_S):
            raise CommandFailed(
                "timing-testbed.page-stale", "the controller has stopped writing its timing page", ExitCode.SAFETY_STOP
            )
        assert self._last is not None
        return self._last

    def mark(self) -> Mark:
        """Begin a span with the next timing page."""
        page = self.fresh_timing()
        return page, None if self._counter is None else count(self._counter)

    def since(self, mark: Mark) -> Span:
        """Return the span since a mark, up to the next timing page."""
        (first, counted), (last, counted_now) = mark, self.mark()
        between = {name: after - first.durations[name] for name, after in last.durations.items()}
        executed = None if counted is None or counted_now is None else counted_now - counted
        return Span(first.facts, last.facts, between, executed)

    def until(self, reached: Callable[[], bool], seconds: float, period_s: float = 0.02) -> bool:
        """Check the processes until something is reached; False if it is not within this time."""
        limit = time.monotonic() + seconds
        while not reached():
            self.poll()
            if time.monotonic() > limit:
                return False
            time.sleep(period_s)
        return True

    def wait(self, seconds: float) -> None:
        """Let the testbed run for a time and check its processes."""
        self.until(lambda: False, seconds, 0.1)

    def await_end(self, name: str, seconds: float) -> dict[str, Any]:
        """Wait until a helper ends by itself; returns its output, and raises CommandFailed if it fails or hangs."""
        child = self.helpers.children[name]
        output: dict[str, Any] = {}

        def ended() -> bool:
            gone = child.process.poll() is not None
            for who, message in self.helpers.messages():
                output.update(message if who == name else {})
            return gone

        if not self.until(ended, seconds, 0.05):
            raise CommandFailed(
                "timing-testbed.helper-hangs", f"{name} does not end; see {child.errors}", ExitCode.CONFIGURATION
            )
        self.end_helper(name)
        return output

    def end_helper(self, name: str) -> None:
        """Stop a helper that writes its report when it is stopped; raises CommandFailed if it failed."""
        complaint = self.helpers.children[name].complaint
        if code := self.helpers.stop(name, WAIT_S):
            raise CommandFailed(
                "timing-testbed.helper-failed",
                f"{name} failed with exit code {code}: {complaint()}",
                ExitCode.CONFIGURATION,
            )

    def close(self) -> None:
        """Stop everything, neutral commands first."""
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        if self._counter is not None:
            os.close(self._counter)
        self.helpers.stop_all(())
        self.family.stop_all(END_ORDER)
        shutil.rmtree(self._private, ignore_errors=True)
        shutil.rmtree(guard_path(self._operators).parent, ignore_errors=True)
