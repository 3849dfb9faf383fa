"""The loop around `step`: sleep to the deadline, receive, step, send, record.  Nothing is decided here.

Deadlines are absolute on CLOCK_MONOTONIC; a late loop skips whole periods and never catches up in a burst.  A cycle
begins with SYNC, one lead before the tick: the encoders answer, and the tick decodes the answers and sends the command
that follows from them::

    SYNC -- lead -- receive, decode, estimate, reference, accept, supervise, control, encode, send, record -- SYNC ...

`step` gets the nominal time and the lateness, so that a record replays to the same bytes.  Authenticators are checked
and taken away before it, and added after it: no record holds a key's work.  However the loop ends, it
sends neutral commands and a last status.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence

from can_dbc.bus.base import Bus
from can_dbc.messages.envelope import signed
from can_dbc.messages.record_ring import RecordRing
from can_dbc.messages.tick_record import RecordWriter
from controller.process.bus_link import BusLink
from controller.process.operator_socket import OperatorSocket
from controller.process.realtime import sleep_until
from controller.process.setpoint_port import Address, SetpointPort
from controller.process.tick_recording import write
from controller.process.timing import LoopTiming
from controller.step import Controller, step
from controller.tick import Inputs, Outputs
from machine.status.explanation import describe
from runtime.errors import InputRefused, LinkError
from runtime.notifier import Notifier


class Loop:
    """Runs a controller on its buses (crane0, and mach0 on a machine with a carrier) until `stop`.

    ``key`` authenticates setpoints and reports; None: both have only their checksum.
    """

    def __init__(
        self,
        controller: Controller,
        buses: Sequence[Bus],
        setpoints: socket.socket,
        operator: OperatorSocket | None,
        reports: Sequence[Address],
        record: RecordRing | None,
        timing: LoopTiming,
        period_ns: int,
        sync_lead_ns: int,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_until,
        notify: str | None = None,
        key: bytes | None = None,
    ) -> None:
        self.controller = controller
        self.buses = tuple(buses)
        self._setpoints, self.operator = SetpointPort(setpoints, key), operator
        self.timing = timing
        self.ticks = self.missed = self.unsent = self.unrecorded = 0
        self.stopping = False
        self._crane, *more = (BusLink(bus) for bus in buses)
        self._machine = more[0] if more else None
        self._reports = [_connected(address) for address in reports]
        self._record, self._key = record, key
        self._period_ns, self._sync_lead_ns = period_ns, sync_lead_ns
        self._clock_ns, self._sleep = clock_ns, sleep
        self._inputs = Inputs()
        self._writer = RecordWriter()
        self._notifier = Notifier(self.status_text, notify)

    def stop(self) -> None:
        """Request the end; the running tick is completed."""
        self.stopping = True

    def run(self) -> None:
        """Tick until `stop`; always ends with neutral commands."""
        period_ns = self._period_ns
        deadline_ns = self._clock_ns() + period_ns
        try:
            while not self.stopping:
                if self.ticks:
                    self._send_sync(deadline_ns - self._sync_lead_ns)
                self._sleep(deadline_ns)
                late_ns = self._clock_ns() - deadline_ns
                if late_ns >= period_ns:
                    skipped = late_ns // period_ns
                    self.missed += skipped
                    deadline_ns += skipped * period_ns
                self.tick(deadline_ns, late_ns)
                deadline_ns += period_ns
        finally:
            self.shut_down()

    def _send_sync(self, deadline_ns: int) -> None:
        """Send SYNC at its time."""
        self._sleep(deadline_ns)
        late_ns = self._clock_ns() - deadline_ns
        self._crane.bus.send(*self.controller.outputs.sync)
        self.timing.sync_sent(late_ns)

    def tick(self, now_ns: int, late_ns: int) -> Outputs:
        """Run one tick at its nominal time."""
        timing, inputs, machine = self.timing, self._inputs, self._machine
        timing.begin(late_ns)
        self._crane.receive(inputs.frames, inputs.bus)
        if machine is not None:
            machine.receive(inputs.machine_frames, inputs.machine_bus)
        self._receive_datagrams(inputs)
        inputs.late_ns, inputs.missed_ticks = late_ns, self.missed
        timing.lap()
        outputs = step(self.controller, inputs, now_ns, timing.lap)
        self._crane.send(outputs.frames)
        timing.command_sent()
        if machine is not None:
            machine.send(outputs.machine_frames)
        timing.lap()
        self._report_and_record(inputs, outputs, now_ns)
        self._crane.watch(now_ns)
        if machine is not None:
            machine.watch(now_ns)
        # Freed now, while they are in the processor's cache, and not at the beginning of the next tick.
        inputs.frames.clear()
        inputs.machine_frames.clear()
        inputs.operator.clear()
        inputs.datagrams.clear()
        inputs.tick_ns = timing.end()
        self.ticks += 1
        # A tick is good when it is on time and within its period.  A lost bus does not make it bad.
        self._notifier.tick_done(now_ns, late_ns < self._period_ns and inputs.tick_ns < self._period_ns)
        return outputs

    def status_text(self) -> str:
        """Describe the state in one line: mode, reason, buses that are not OK, missed ticks."""
        supervisor = self.controller.supervisor
        reason = describe(supervisor.reason, supervisor.detail, self.controller.evidence.numbers)
        buses = "".join(f"{bus.name} is {bus.stats.state.name}. " for bus in self.buses if bus.stats.state)
        missed = f"Missed ticks: {self.missed} of {self.ticks + self.missed}."
        return f"{supervisor.mode.name}. {reason} {buses}{self._setpoints.strangers_text()}{missed}"

    def shut_down(self) -> None:
        """Send neutral commands and a last status, so that no node has to wait for a time-out."""
        self._crane.send(self.controller.shutdown_frames())
        if self._machine is not None:
            self._machine.send(self.controller.carrier_shutdown_frames())
        self._notifier.stopping()

    def close(self) -> None:
        """Close the sockets, the buses and the timing page."""
        for receiver in self._reports:
            receiver.close()
        if self._record is not None:
            self._record.close()
        self._setpoints.close()
        if self.operator is not None:
            self.operator.close()
        for bus in self.buses:
            bus.close()
        self.timing.close()

    def _receive_datagrams(self, inputs: Inputs) -> None:
        """Receive the operator's commands, and the setpoints that fit into a tick."""
        datagrams = inputs.datagrams
        inputs.operator.clear()
        datagrams.clear()
        if self.operator is not None:
            self.operator.receive(inputs.operator, datagrams)
        self._setpoints.receive(datagrams)

    def _report_and_record(self, inputs: Inputs, outputs: Outputs, now_ns: int) -> None:
        """Send reports and the tick's record, and publish the timing page once a second."""
        for report in (outputs.report, outputs.vehicle_report):
            if report is not None:
                sent = report if self._key is None else signed(report, self._key)
                for receiver in self._reports:
                    self.unsent += not _send(receiver, sent)
        if self._record is not None:
            try:
                self._record.append(write(self._writer, inputs, outputs, now_ns))
            except InputRefused:
                self.unrecorded += 1
        if now_ns >= self.timing.publish_ns:
            supervisor = self.controller.supervisor
            self.timing.publish(
                now_ns,
                self._period_ns,
                self.missed,
                supervisor.late,
                supervisor.mode.name,
                self.status_text(),
                self.buses,
            )


def _connected(address: Address) -> socket.socket:
    """Make a socket that never blocks and sends to one address.

    The kernel looks for its way once and not in every tick.

    Raises:
        LinkError: there is no way to the address.
    """
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    try:
        made.connect(address)
    except OSError as error:
        made.close()
        where = f"{address[0]}:{address[1]}"
        sentence = f"Nothing can be sent to {where} ({error}); check --report, or the network."
        raise LinkError("udp.unreachable", sentence) from error
    return made


def _send(receiver: socket.socket, data: bytes) -> bool:
    """Tell whether the system took a datagram; not while nobody listens."""
    try:
        return receiver.send(data) == len(data)
    except OSError:
        return False
