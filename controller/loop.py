"""The thin shell around `step`: sleep to the deadline, drain, step, send, count.  Nothing is decided here.

Absolute deadlines on CLOCK_MONOTONIC; a late loop skips whole periods and never catches up in a burst.  A cycle begins
with SYNC, a lead before the tick; the encoders answer, and the tick decodes the answers and sends the command that
follows from them::

    SYNC ---- lead ---- tick: read, decode, estimate, supervise, law, encode, send | tell --- SYNC ---- lead ---- tick

`step` gets the nominal time and is told the lateness, so that a record replays to the same bytes.  On the way out,
whatever the way, neutral commands and a last status are sent.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Sequence
from typing import Final

from can_dbc.bus import Bus
from controller.link import Link
from controller.realtime import Notifier, sleep_until
from controller.record import record
from controller.step import Controller, Inputs, Outputs, step
from controller.timing import LoopTiming
from machine.faults import describe

Address = tuple[str, int]
MAX_DATAGRAMS: Final = 16
"""Most datagrams taken in one tick; more than that is a flood, and the rest waits."""
DATAGRAM_BYTES: Final = 2048


class Loop:
    """Runs a controller on its buses (crane0, and mach0 on a machine that has a carrier) until told to stop."""

    def __init__(
        self,
        controller: Controller,
        buses: Sequence[Bus],
        setpoints: socket.socket,
        reports: Sequence[Address],
        record: Address | None,
        timing: LoopTiming,
        period_ns: int,
        sync_lead_ns: int,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_until,
        notify: str | None = None,
    ) -> None:
        self.controller = controller
        self.buses = tuple(buses)
        self.setpoints = setpoints
        self.timing = timing
        self.ticks = self.missed = self.unsent = self.unrecorded = 0
        self.stopping = False
        self._crane, *more = (Link(bus) for bus in buses)
        self._machine = more[0] if more else None
        self._reports = tuple(reports)
        self._record = record
        self._period_ns, self._sync_lead_ns = period_ns, sync_lead_ns
        self._clock_ns, self._sleep = clock_ns, sleep
        self._inputs = Inputs()
        self._notifier = Notifier(self.words, notify)
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sender.setblocking(False)

    def stop(self) -> None:
        """Asks for the end; the tick that runs is finished."""
        self.stopping = True

    def run(self) -> None:
        """Ticks until `stop`; always leaves neutral commands behind."""
        period_ns = self._period_ns
        deadline_ns = self._clock_ns() + period_ns
        try:
            while not self.stopping:
                if self.ticks:
                    self._ask(deadline_ns - self._sync_lead_ns)
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

    def _ask(self, deadline_ns: int) -> None:
        """SYNC at its time."""
        self._sleep(deadline_ns)
        late_ns = self._clock_ns() - deadline_ns
        self._crane.bus.send(*self.controller.outputs.sync)
        self.timing.synced(late_ns)

    def tick(self, now_ns: int, late_ns: int) -> Outputs:
        """One tick at its nominal time."""
        timing, inputs, machine = self.timing, self._inputs, self._machine
        timing.begin(late_ns)
        self._crane.read(inputs.frames, inputs.bus)
        if machine is not None:
            machine.read(inputs.machine_frames, inputs.machine_bus)
        self._receive(inputs.datagrams)
        inputs.late_ns, inputs.missed_ticks = late_ns, self.missed
        timing.lap()
        outputs = step(self.controller, inputs, now_ns, timing.lap)
        self._crane.send(outputs.frames)
        timing.commanded()
        if machine is not None:
            machine.send(outputs.machine_frames)
        timing.lap()
        self._tell(inputs, outputs, now_ns)
        self._crane.watch(now_ns)
        if machine is not None:
            machine.watch(now_ns)
        inputs.tick_ns = timing.end()
        self.ticks += 1
        # Good: on time, and done within its period.  A bus that is lost is bad news, not a bad tick.
        self._notifier.ticked(now_ns, late_ns < self._period_ns and inputs.tick_ns < self._period_ns)
        return outputs

    def words(self) -> str:
        """How it is, in one line: mode, the reason in words, a bus that is not well, missed ticks."""
        supervisor = self.controller.supervisor
        reason = describe(supervisor.reason, supervisor.detail)
        buses = "".join(f"{bus.name} is {bus.stats.state.name}. " for bus in self.buses if bus.stats.state)
        return f"{supervisor.mode.name}. {reason} {buses}Missed ticks: {self.missed} of {self.ticks + self.missed}."

    def leave(self) -> None:
        """Sends neutral commands and a last status, so that nobody waits for a time-out."""
        self._crane.send(self.controller.farewell())
        if self._machine is not None:
            self._machine.send(self.controller.machine_farewell())
        self._notifier.stopping()

    def close(self) -> None:
        """Closes the sockets, the buses and the timing page."""
        self._sender.close()
        self.setpoints.close()
        for bus in self.buses:
            bus.close()
        self.timing.close()

    def _receive(self, datagrams: list[bytes]) -> None:
        datagrams.clear()
        for _ in range(MAX_DATAGRAMS):
            try:
                datagrams.append(self.setpoints.recv(DATAGRAM_BYTES))
            except OSError:  # nothing waits, or a former report met a closed port
                return

    def _tell(self, inputs: Inputs, outputs: Outputs, now_ns: int) -> None:
        """What nobody waits for: reports, the tick's record, once a second the timing page."""
        for report in (outputs.report, outputs.vehicle_report):
            if report is not None:
                for address in self._reports:
                    self.unsent += not self._send(report, address)
        if self._record is not None:
            self.unrecorded += not self._send(record(inputs, outputs, now_ns), self._record)
        if now_ns >= self.timing.publish_ns:
            supervisor = self.controller.supervisor
            self.timing.publish(
                now_ns, self._period_ns, self.missed, supervisor.late, supervisor.mode.name, self.words(), self.buses
            )

    def _send(self, data: bytes, address: Address) -> bool:
        with contextlib.suppress(OSError):
            return self._sender.sendto(data, address) == len(data)
        return False
