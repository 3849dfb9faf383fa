"""The processes around the controller on the testbed: ``python -m experiments.timing.stand_ins PART --profile NAME``.

``machine`` emulates every CAN node on its buses, around joints that follow their valves (`sim.kinematic`): the traffic
of the whole machine for a fraction of a core.  ``--cycle-us`` is the period of the PLC and the fast pressures.
``setpoints`` arms the machine and moves every joint slowly, so that the laws work.
``observer`` reads the ring of tick records: are frames missing that the controller received or sent, or records apart
from missed periods?

Each prints ``ready``, then a JSON line a second until SIGTERM or SIGINT.  Exit codes: 0 stopped; 2 usage; 4 bus.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from can_dbc.bus.base import Bus
from can_dbc.bus.factory import open_bus
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages import operator_link
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused, read_key
from can_dbc.messages.record_ring import RingReader
from can_dbc.messages.tick_record import TickRecord
from can_dbc.messages.tick_record import decode as decode_record
from can_dbc.messages.udp_address import address_argument
from can_dbc.protocols.canopen import SYNC_ID
from can_dbc.protocols.e2e import Checker, Status
from hil.harness.operator import Operator
from hil.harness.processes import announce_ready
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile, profile_check, profile_hash
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.modes import Mode
from runtime.errors import InputRefused, LinkError
from sim.kinematic import KinematicMachine
from sim.process.live import TX_QUEUE_FRAMES, LiveMachine

STEP_NS: Final = 2_500_000
PRINT_PERIOD_NS: Final = 1_000_000_000
POLL_PERIOD_S: Final = 0.05
"""A fortieth of what the ring holds at 1 kHz."""
SEND_PERIOD_NS: Final = 50_000_000
KNOTS_MS: Final = (0, 100, 200, 300, 400)
LEASE_MS: Final = 200
STAMP_AGE_NS: Final = 2_000_000
"""Age of a time stamp when it is sent: a controller in the middle of its tick must not find it in the future."""
SWING_SHARE: Final = 0.05
"""Amplitude of the swing as a share of the joint's range."""
REASON_MASK: Final = 0xFF
"""The bits above it hold the detail."""
SPEED_SHARE: Final = 0.4
"""Share of the joint's speed and acceleration limits used by the motion."""


class Printer:
    """Prints a JSON line once a second."""

    def __init__(self) -> None:
        self._next_ns = 0

    def print(self, now_ns: int, document: Callable[[], Mapping[str, object]]) -> None:
        """Print the document if it is time."""
        if now_ns >= self._next_ns:
            self._next_ns = now_ns + PRINT_PERIOD_NS
            print(json.dumps(document()), flush=True)


class Continuity:
    """Frames that one participant saw on a bus.

    ``frames`` counts them by key; ``gaps`` and ``damaged`` count protected frames with a counter that is not
    consecutive, or with a wrong CRC.
    """

    def __init__(self, profile: Profile) -> None:
        names = ("crane", "machine") if profile.machine_bus else ("crane",)
        every = [m for name in names for m in load(name).messages.values()]
        self._checkers = {m.key: Checker(m.data_ids) for m in every if m.data_ids}
        self.frames: Counter[int] = Counter()
        self.gaps = self.damaged = 0

    def add(self, key: int, data: bytes) -> None:
        """Add one frame, in the order of the bus."""
        self.frames[key] += 1
        checker = self._checkers.get(key)
        if checker is None:
            return
        last = checker.counter
        if checker.check(data) is Status.ERROR:
            self.damaged += 1
        elif 0 <= last != (checker.counter - 1) & 0x0F:
            self.gaps += 1


class BusObserver:
    """Tick records in, totals out; pure."""

    def __init__(self, profile: Profile, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last: TickRecord | None = None
        self.received, self.sent = Continuity(profile), Continuity(profile)
        specs = [s.encoder for s in profile.joints.values() if s.encoder]
        specs += [profile.carrier.articulation_encoder] if profile.carrier else []
        self._encoders = [load("crane").message(spec.message).key for spec in specs]
        self._first: dict[int, int] = {}
        self.records = self.lost = self.unreadable = 0

    def add(self, data: bytes) -> None:
        """Add one record."""
        try:
            record = decode_record(data)
        except InputRefused:
            self.unreadable += 1
            return
        last, self._last = self._last, record
        self.records += 1
        if last is not None:
            passed = (record.now_ns - last.now_ns) // self._period_ns
            self.lost += max(0, passed - 1 - (record.missed_ticks - last.missed_ticks))
        for frame in (*record.frames_in, *record.machine_frames_in):
            self.received.add(frame.key, frame.data)
        for key, payload in (*record.frames_out, *record.machine_frames_out):
            self.sent.add(key, payload)
        if not self._first and all(self.received.frames[key] for key in self._encoders):
            self._first = {key: self.received.frames[key] for key in self._encoders}
            self._first[SYNC_ID] = self.sent.frames[SYNC_ID]

    def unanswered(self) -> int:
        """Count SYNCs without an answer of at least one encoder since all encoders run; one may be in flight."""
        if not self._first:
            return 0
        syncs = self.sent.frames[SYNC_ID] - self._first[SYNC_ID]
        answers = min(self.received.frames[key] - self._first[key] for key in self._encoders)
        return max(0, syncs - answers - 1)

    def totals(self) -> dict[str, int]:
        """Return all counters."""
        return {
            "records": self.records,
            "records_lost": self.lost,
            "records_unreadable": self.unreadable,
            "received": self.received.frames.total(),
            "sent": self.sent.frames.total(),
            "gaps": self.received.gaps + self.sent.gaps,
            "damaged": self.received.damaged + self.sent.damaged,
            "unanswered": self.unanswered(),
        }


def observe(profile: Profile, ticks: Path, rate_hz: int) -> None:
    """Print the totals of the tick records."""
    observer, printer, ring = BusObserver(profile, 1_000_000_000 // rate_hz), Printer(), RingReader(ticks)
    ended = announce_ready()
    while not ended:
        time.sleep(POLL_PERIOD_S)
        for record in ring.read():
            observer.add(record)
        printer.print(time.monotonic_ns(), observer.totals)
    Printer().print(time.monotonic_ns(), observer.totals)
    ring.close()


class EmulatedMachine(LiveMachine):
    """A kinematic machine that prints its timing and lost frames, until a signal is in ``ended``."""

    def __init__(self, machine: KinematicMachine, buses: Mapping[str, Bus], continuity: Continuity) -> None:
        super().__init__(machine, buses)
        self._continuity, self._printer = continuity, Printer()
        self.ended: list[int] = []

    def _on_received(self, frames: list[Frame]) -> None:
        for frame in frames:
            self._continuity.add(frame.key, frame.data)

    def _on_step(self, now_ns: int) -> None:
        self._printer.print(now_ns, self._totals)
        if self.ended:
            self.stop()

    def _totals(self) -> dict[str, float]:
        return self.report() | {"gaps": self._continuity.gaps, "damaged": self._continuity.damaged}


def emulate(profile: Profile, addresses: Sequence[str], cycle_ns: int) -> None:
    """Emulate the machine on its buses (NAME=ADDRESS)."""
    machine = KinematicMachine(profile, 1, step_ns=min(STEP_NS, cycle_ns), cycle_ns=cycle_ns)
    with contextlib.ExitStack() as stack:
        buses = {}
        for name, _, address in (text.partition("=") for text in addresses):
            buses[name] = stack.enter_context(open_bus(address, tx_queue=TX_QUEUE_FRAMES, participant="rig"))
        live = EmulatedMachine(machine, buses, Continuity(profile))
        live.ended = announce_ready()
        live.run()


class Swing:
    """The motion of one joint: ``start + reach * (1 - cos(w t)) / 2``, at rest at t = 0, towards the farther end.

    ``rises``: towards the upper end wherever the range allows it, as a boom that sinks takes the grapple to the ground.
    """

    def __init__(
        self, start: float, lower: float, upper: float, speed: float, acceleration: float, rises: bool = False
    ) -> None:
        self.start = start
        reach = 2 * SWING_SHARE * (upper - lower)
        self.reach = reach if upper - start > (reach if rises else start - lower) else -reach
        half = abs(self.reach) / 2
        self.w = SPEED_SHARE * min(speed / half, math.sqrt(acceleration / half))

    def at(self, t_s: float) -> tuple[float, float]:
        """Return position and velocity."""
        half, angle = self.reach / 2, self.w * t_s
        return self.start + half * (1.0 - math.cos(angle)), half * self.w * math.sin(angle)


class SetpointSource:
    """Reports in, datagrams out; pure.  It sends setpoints in which each joint swings through a tenth of its range."""

    def __init__(self, profile: Profile, key: bytes | None = None, check: int = 0) -> None:
        self._key = key
        self._specs = [profile.joints[j.name.lower()] for j in JOINTS]
        self._hash = profile_hash(profile)
        self.operator = Operator(self._hash, lambda _action, _report: None, profile_check=check)
        self._swings: list[Swing] = []
        self._begin_ns = 0
        self._sequence = 0
        self.report: StateReport | None = None

    def receive(self, report: StateReport) -> bytes | None:
        """Receive a report; returns the command of the emulated operator, if any."""
        self.report = report
        if report.mode not in (Mode.ARMED, Mode.ACTIVE):
            self._swings = []
        return self.operator.step(report)

    def setpoint(self, now_ns: int) -> bytes | None:
        """Return the setpoint to send now; None while the machine is not armed."""
        report, stamp_ns = self.report, now_ns - STAMP_AGE_NS
        if report is None or report.mode not in (Mode.ARMED, Mode.ACTIVE):
            return None
        if not self._swings:
            self._swings, self._begin_ns = self._from(report.reference), stamp_ns
        self._sequence += 1
        begin_s = (stamp_ns - self._begin_ns) * 1e-9
        knots = tuple(self._knot(ms, begin_s + 1e-3 * ms) for ms in KNOTS_MS)
        lease_ns = LEASE_MS * 1_000_000
        setpoint = CraneSetpoint(self._sequence, self._hash, stamp_ns, lease_ns, GrappleCommand.NEUTRAL, False, knots)
        return encode(setpoint, self._key)

    def _from(self, reference: Sequence[float]) -> list[Swing]:
        """Make the swings; a joint without an encoder starts at 0, as the controller's reference does."""
        return [
            Swing(0.0 if math.isnan(q) else q, s.lower, s.upper, s.speed_limit, s.acceleration_limit, j is Joint.LIFT)
            for j, q, s in zip(JOINTS, reference, self._specs, strict=True)
        ]

    def _knot(self, after_ms: int, t_s: float) -> Knot:
        positions, velocities = zip(*(swing.at(t_s) for swing in self._swings), strict=True)
        return Knot(1_000_000 * after_ms, positions, velocities)

    def state(self) -> dict[str, object]:
        """Describe the newest report."""
        assert self.report is not None
        mode, refused, refusal = Mode(self.report.mode).name, self.report.refused, describe(self.report.refusal)
        return {"mode": mode, "refused": refused, "refusal": refusal, "stamp_ns": self.report.stamp_ns}


def send_setpoints(source: SetpointSource, key: bytes, controller: tuple[str, int], operator: Path, port: int) -> None:
    """Send setpoints and the operator's commands, and print every change of mode."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", port))
        link.settimeout(0.02)
        ended, printer = announce_ready(), Printer()
        send_ns, mode = 0, -1
        while not ended:
            try:
                message = decode(link.recv(2048), key)
            except (OSError, DatagramRefused):  # no controller yet, or another datagram
                message = None
            if isinstance(message, StateReport):
                if press := source.receive(message):
                    with contextlib.suppress(OSError):  # it has ended
                        operator_link.send(press, operator)
                if message.mode != mode:
                    mode, reason = message.mode, message.reason
                    change = {"event": "mode", "why": describe(reason), "reason": reason & REASON_MASK}
                    print(json.dumps(change | source.state()), flush=True)
            now_ns = time.monotonic_ns()
            if now_ns >= send_ns and (datagram := source.setpoint(now_ns)):
                send_ns = max(send_ns + SEND_PERIOD_NS, now_ns)
                link.sendto(datagram, controller)
            if source.report is not None:
                printer.print(now_ns, lambda: {"event": "report"} | source.state())


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.timing.stand_ins", description="Part of the testbed.")
    parser.add_argument("part", choices=("machine", "setpoints", "observer"))
    parser.add_argument("--profile", required=True)
    parser.add_argument("--bus", action="append", default=[], metavar="NAME=ADDRESS", help="of the machine")
    parser.add_argument("--cycle-us", type=int, default=5000)
    parser.add_argument("--controller", type=address_argument, metavar="HOST:PORT", help="where setpoints go")
    parser.add_argument("--operator", type=Path, metavar="FILE")
    parser.add_argument("--report-port", type=int)
    parser.add_argument("--key-file", type=Path)
    parser.add_argument("--ticks", type=Path, help="ring of the tick records")
    parser.add_argument("--rate", type=int, metavar="HZ")
    o = parser.parse_args(arguments)
    profile = load_profile(o.profile)
    if o.part == "machine":
        try:
            emulate(profile, o.bus, 1000 * o.cycle_us)
        except (LinkError, OSError) as error:
            sys.stderr.write(f"emulated machine: {error}\n")
            return 4
    elif o.part == "setpoints":
        key = read_key(o.key_file)
        source = SetpointSource(profile, key, profile_check(o.profile))
        send_setpoints(source, key, o.controller, o.operator, o.report_port)
    else:
        observe(profile, o.ticks, o.rate)
    return 0


if __name__ == "__main__":
    sys.exit(main())
