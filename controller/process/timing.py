"""Timing of the loop: lateness, duration of each stage, age of each input, and the system's counters.

All storage is allocated at start; a tick only adds to it.  Once a second it is published in shared memory
(`can_dbc.timing.page`).
"""

from __future__ import annotations

import gc
import os
import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import Final

from can_dbc.bus.base import Bus
from can_dbc.timing.durations import Durations
from can_dbc.timing.page import STAGES, BusCounters, Facts, InputAge, ProcessCounters, TimingWriter
from controller.bus_io import MessageState
from controller.step import Controller
from runtime.compiled import running

PUBLISH_NS: Final = 1_000_000_000
_LAPS: Final = ("receive", "decode", "estimate", "supervise", "control", "encode", "send", "record")
_PAGE_KB: Final = os.sysconf("SC_PAGESIZE") >> 10


class LoopTiming:
    """Stopwatch of the loop.  In a tick call `begin`, `lap` after each stage, `command_sent`, `end`."""

    __slots__ = (
        "_at",
        "_begin_ns",
        "_clock_ns",
        "_cpu_begin_ns",
        "_cpu_ns",
        "_encoders",
        "_inputs",
        "_laps",
        "_last_ns",
        "_longest_ns",
        "_newest_ns",
        "_previous_sync_ns",
        "_process",
        "_states",
        "_sync_ns",
        "_tick",
        "_ticks",
        "_uses",
        "_writer",
        "cpu",
        "durations",
        "publish_ns",
        "sample_to_command",
        "started_ns",
        "sync",
        "tick",
        "wake",
    )

    def __init__(
        self,
        controller: Controller,
        writer: TimingWriter | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        cpu_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self.durations = {name: Durations() for name in STAGES}
        self.wake, self.sync, self.tick, self.cpu, self.sample_to_command = (
            self.durations[name] for name in ("wake", "sync", "tick", "cpu", "sample_to_command")
        )
        self._laps = [self.durations[name] for name in _LAPS]
        self._inputs = controller.inputs_in_use
        self._states: list[MessageState] = [state for _, state in self._inputs]
        # Ages of the inputs by place: numbers in lists, because an attribute of `InputAge` is found by its name.
        self._newest_ns, self._longest_ns, self._uses = ([0] * len(self._states) for _ in range(3))
        self._encoders: tuple[MessageState, ...] = tuple(
            state for state in controller.crane_inputs.encoders if state is not None
        )
        self._writer = writer
        self._process = ProcessReader()
        self._tick, self._ticks = str(running()), 0
        self._clock_ns, self._cpu_ns = clock_ns, cpu_ns
        self.started_ns = clock_ns()
        self.publish_ns = self._at = self._begin_ns = self._last_ns = self._cpu_begin_ns = 0
        self._sync_ns = self._previous_sync_ns = 0

    def sync_sent(self, late_ns: int) -> None:
        """Note that SYNC was sent: the encoders sample now."""
        self._previous_sync_ns, self._sync_ns = self._sync_ns, self._clock_ns()
        self.sync.add(late_ns)

    def begin(self, late_ns: int) -> None:
        """Begin a tick."""
        self._cpu_begin_ns = self._cpu_ns()
        self._begin_ns = self._last_ns = self._clock_ns()
        self._at = 0
        self.wake.add(late_ns)

    def lap(self) -> None:
        """End a stage."""
        now_ns = self._clock_ns()
        self._laps[self._at].add(now_ns - self._last_ns)
        self._last_ns = now_ns
        self._at += 1

    def command_sent(self) -> None:
        """Measure the age of the samples of the valve commands that were sent, from the SYNC of the oldest encoder
        sample.
        """
        oldest_ns = self._last_ns
        for state in self._encoders:
            if state.values is None:
                return
            if state.stamp_ns < oldest_ns:
                oldest_ns = state.stamp_ns
        for sync_ns in (self._sync_ns, self._previous_sync_ns):
            if sync_ns <= oldest_ns:
                self.sample_to_command.add(self._clock_ns() - sync_ns)
                return
        self.sample_to_command.add(self._clock_ns() - oldest_ns)

    def end(self) -> int:
        """End a tick; returns its duration."""
        begin_ns, newest_ns, longest_ns, uses = self._begin_ns, self._newest_ns, self._longest_ns, self._uses
        for i, state in enumerate(self._states):
            if state.fresh:
                age_ns = begin_ns - state.stamp_ns
                newest_ns[i] = age_ns
                uses[i] += 1
                if age_ns > longest_ns[i]:
                    longest_ns[i] = age_ns
        self._ticks += 1
        self.lap()
        duration_ns = self._last_ns - begin_ns
        self.tick.add(duration_ns)
        self.cpu.add(self._cpu_ns() - self._cpu_begin_ns)
        return duration_ns

    def publish(
        self, now_ns: int, period_ns: int, missed: int, late: int, mode: str, status: str, buses: Sequence[Bus]
    ) -> None:
        """Write the page; call it when ``publish_ns`` is reached."""
        self.publish_ns = now_ns + PUBLISH_NS
        if self._writer is None:
            return
        facts = Facts(
            pid=os.getpid(),
            started_ns=self.started_ns,
            written_ns=now_ns,
            period_ns=period_ns,
            ticks=self._ticks,
            missed=missed,
            late=late,
            mode=mode,
            words=status,
            buses=tuple([_bus_counters(bus) for bus in buses]),
            process=self._process.read(),
            inputs={
                name: InputAge(self._newest_ns[i], self._longest_ns[i], self._uses[i], state.refused)
                for i, (name, state) in enumerate(self._inputs)
            },
            longest_ns=tuple([self.durations[name].longest_ns for name in STAGES]),
            total_ns=tuple([self.durations[name].total_ns for name in STAGES]),
            tick=self._tick,
        )
        self._writer.publish(facts, self.durations)

    def close(self) -> None:
        """Remove the page."""
        self._process.close()
        if self._writer is not None:
            self._writer.close()


def _bus_counters(bus: Bus) -> BusCounters:
    stats = bus.stats
    return BusCounters(
        bus.name,
        stats.state.name,
        stats.received,
        stats.sent,
        stats.refused,
        stats.dropped,
        stats.error_frames,
        stats.recoveries,
    )


class ProcessReader:
    """Reads the system's counters of this process, with two system calls."""

    __slots__ = ("_statm",)

    def __init__(self) -> None:
        self._statm = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)

    def read(self) -> ProcessCounters:
        """Read the counters now."""
        used = resource.getrusage(resource.RUSAGE_SELF)
        resident_pages = int(os.pread(self._statm, 128, 0).split()[1])
        return ProcessCounters(
            cpu_ns=round((used.ru_utime + used.ru_stime) * 1e9),
            minor_faults=used.ru_minflt,
            major_faults=used.ru_majflt,
            voluntary_switches=used.ru_nvcsw,
            involuntary_switches=used.ru_nivcsw,
            gc_runs=sum([generation["collections"] for generation in gc.get_stats()]),
            allocated_blocks=sys.getallocatedblocks(),
            resident_kb=resident_pages * _PAGE_KB,
        )

    def close(self) -> None:
        """Close the descriptor; may be called twice."""
        if self._statm >= 0:
            os.close(self._statm)
            self._statm = -1
