"""The thin shell around `step`: sleep to the deadline, drain, step, send, count.  Nothing is decided here.

Absolute deadlines on CLOCK_MONOTONIC; a late loop skips whole periods and never catches up in a
burst.  `step` gets the nominal time and is told the lateness, so that a record replays to the same bytes.  On
the way out, whatever the way, neutral commands and a last status are sent.
"""

from __future__ import annotations

import contextlib
import socket
import time
from array import array
from collections.abc import Callable, Sequence
from typing import Final

from can_dbc import tick_record
from can_dbc.bus import Bus, BusState
from controller.realtime import Notifier, sleep_until
from controller.step import Controller, Inputs, Outputs, step
from machine.faults import describe

Address = tuple[str, int]
MAX_DATAGRAMS: Final = 16
"""Most datagrams taken in one tick; more than that is a flood, and the rest waits."""
DATAGRAM_BYTES: Final = 2048
BUS_GONE_NS: Final = 200_000_000
"""A link that stays down this long ends the process."""


class Histogram:
    """Counts of durations in fixed bins of 10 us up to 10 ms and one for the rest; never grows."""

    __slots__ = ("bins", "count", "longest_ns")
    BIN_NS: Final = 10_000
    BINS: Final = 1000

    def __init__(self) -> None:
        self.bins = array("Q", [0] * (self.BINS + 1))
        self.count = 0
        self.longest_ns = 0

    def add(self, duration_ns: int) -> None:
        """Counts one duration."""
        self.bins[min(max(duration_ns, 0) // self.BIN_NS, self.BINS)] += 1
        self.count += 1
        self.longest_ns = max(self.longest_ns, duration_ns)

    def quantile_ns(self, share: float) -> int:
        """Upper edge of the bin in which ``share`` of the durations are reached; 0 when empty."""
        wanted, seen = share * self.count, 0
        for i, n in enumerate(self.bins):
            seen += n
            if n and seen >= wanted:
                return min((i + 1) * self.BIN_NS, self.longest_ns) if i < self.BINS else self.longest_ns
        return 0

    def summary(self) -> dict[str, float]:
        """Median, p99, p99.9 and longest, in microseconds."""
        quantiles = {"p50_us": 0.5, "p99_us": 0.99, "p999_us": 0.999}
        return {n: self.quantile_ns(q) / 1000 for n, q in quantiles.items()} | {"max_us": self.longest_ns / 1000}


class Loop:
    """Runs a controller on a bus and a UDP socket until told to stop or until the bus is gone."""

    def __init__(
        self,
        controller: Controller,
        bus: Bus,
        setpoints: socket.socket,
        reports: Sequence[Address],
        record: Address | None,
        period_ns: int,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_until,
    ) -> None:
        self.controller = controller
        self.bus = bus
        self.setpoints = setpoints
        self.lateness, self.work = Histogram(), Histogram()
        self.missed = self.unsent = self.unrecorded = 0
        self.stopping = False
        self.bus_lost = False
        self._reports = tuple(reports)
        self._record = record
        self._period_ns = period_ns
        self._clock_ns, self._sleep = clock_ns, sleep
        self._inputs = Inputs()
        self._notifier = Notifier(self.words)
        self._down_since_ns = 0
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sender.setblocking(False)

    def stop(self) -> None:
        """Asks for the end; the tick that runs is finished."""
        self.stopping = True

    def run(self) -> None:
        """Ticks until `stop` or until the bus is gone; always leaves neutral commands behind."""
        period_ns = self._period_ns
        deadline_ns = self._clock_ns() + period_ns
        try:
            while not self.stopping:
                self._sleep(deadline_ns)
                late_ns = self._clock_ns() - deadline_ns
                if late_ns >= period_ns:
                    skipped = late_ns // period_ns
                    self.missed += skipped
                    deadline_ns += skipped * period_ns
                self.tick(deadline_ns, late_ns)
                deadline_ns += period_ns
        finally:
            self.leave()

    def tick(self, now_ns: int, late_ns: int) -> Outputs:
        """One tick at its nominal time."""
        begin_ns = self._clock_ns()
        inputs, stats = self._inputs, self.bus.stats
        inputs.frames.clear()
        self.bus.drain(inputs.frames)
        self._receive(inputs.datagrams)
        inputs.late_ns, inputs.missed_ticks = late_ns, self.missed
        inputs.bus_state, inputs.bus_dropped = stats.state, stats.dropped
        inputs.bus_refused, inputs.bus_errors = stats.refused, stats.error_frames
        outputs = step(self.controller, inputs, now_ns)
        for key, data in outputs.frames:
            self.bus.send(key, data)
        if outputs.report is not None:
            for address in self._reports:
                self.unsent += not self._send(outputs.report, address)
        if self._record is not None:
            self._keep(inputs, outputs, now_ns, self._record)
        self._watch_link(now_ns)
        inputs.tick_ns = self._clock_ns() - begin_ns
        # Good: on time, done within its period, and heard on the bus.
        good = late_ns < self._period_ns and inputs.tick_ns < self._period_ns and stats.state is not BusState.DOWN
        self._notifier.ticked(now_ns, good)
        self.lateness.add(late_ns)
        self.work.add(inputs.tick_ns)
        return outputs

    def words(self) -> str:
        """How it is, in one line: mode, the reason in words, missed ticks."""
        supervisor = self.controller.supervisor
        reason = describe(supervisor.reason, supervisor.detail)
        return f"{supervisor.mode.name}. {reason} Missed ticks: {self.missed} of {self.work.count + self.missed}."

    def leave(self) -> None:
        """Sends neutral commands and a last status, so that nobody waits for a time-out."""
        for key, data in self.controller.farewell():
            self.bus.send(key, data)
        self._notifier.stopping()

    def close(self) -> None:
        """Closes the sockets and the bus."""
        self._sender.close()
        self.setpoints.close()
        self.bus.close()

    def _receive(self, datagrams: list[bytes]) -> None:
        datagrams.clear()
        for _ in range(MAX_DATAGRAMS):
            try:
                datagrams.append(self.setpoints.recv(DATAGRAM_BYTES))
            except OSError:  # nothing waits, or a former report met a closed port
                return

    def _send(self, data: bytes, address: Address) -> bool:
        with contextlib.suppress(OSError):
            return self._sender.sendto(data, address) == len(data)
        return False

    def _keep(self, inputs: Inputs, outputs: Outputs, now_ns: int, address: Address) -> None:
        data = tick_record.encode(
            now_ns, inputs.late_ns, inputs.tick_ns, inputs.missed_ticks,
            (inputs.bus_state, inputs.bus_dropped, inputs.bus_refused, inputs.bus_errors),
            inputs.frames, inputs.datagrams, outputs.frames, outputs.report,
        )  # fmt: skip
        self.unrecorded += not self._send(data, address)

    def _watch_link(self, now_ns: int) -> None:
        if self.bus.stats.state is not BusState.DOWN:
            self._down_since_ns = 0
        elif not self._down_since_ns:
            self._down_since_ns = now_ns
        elif now_ns - self._down_since_ns >= BUS_GONE_NS:
            self.bus_lost = self.stopping = True
