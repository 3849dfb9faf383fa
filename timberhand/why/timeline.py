"""What happened around a stop, as a short list of events: what the controller received, decided and was late for.

Input: the tick records of a stop; output: events in order of time, of the last seconds before it and of the time after.
A message counts as silent when nothing came for its time-out in the DBC.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

from can_dbc.bus.base import BusState
from can_dbc.dbc.codec import Database, MessageCodec, load
from can_dbc.messages import datagrams
from can_dbc.messages.crane import (
    WATCH_PERIOD_NS,
    CraneSetpoint,
    OperatorAction,
    OperatorCommand,
    SpoolTest,
    StateReport,
)
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import BusReading, TickRecord
from can_dbc.messages.vehicle import DriveSetpoint
from can_dbc.protocols.canopen import parse_emergency
from controller.guard.verdicts import Verdict
from controller.supervisor import LATE_NS
from machine.crane_nodes import NODE_NAMES
from machine.status.explanation import explain
from machine.status.modes import STOPPED, Mode
from machine.status.reasons import known
from recorder.stop_recorder import report_of

BEFORE_S: Final = 2.0
"""Events of this time before the stop are listed."""
SETPOINT_SILENCE_NS: Final = 150_000_000
BEAT_SILENCE_NS: Final = 5 * WATCH_PERIOD_NS // 2
WATCHED: Final = {
    "EstopStat": ("ChannelA", "ChannelB", "Person", "Lever", "ModeSwitch", "ResetReq"),
    "GuardStat": ("Enable", "Verdict"),
    "ValveFbA": ("State",),
    "ValveFbB": ("ExitCode",),
    "PlcStatus": ("Mode", "FaultBits"),
    "VehStat": ("Fault",),
}
"""Signals whose every change is an event."""
COUNTERS: Final[dict[str, Callable[[BusReading], int]]] = {
    "frames lost on reception": lambda bus: bus.dropped,
    "frames that could not be sent": lambda bus: bus.refused,
    "error frames": lambda bus: bus.errors,
    "recoveries": lambda bus: bus.recoveries,
}
"""Counters of a bus; a burst of increments is one event."""
BURST_NS: Final = 100_000_000

Ticks = Sequence[TickRecord]
Found = Iterator[tuple[int, str]]
"""Events: time [ns] and text."""


class Event(NamedTuple):
    """One event; ``at_s`` is relative to the stop."""

    at_s: float
    text: str


def events_of(ticks: tuple[TickRecord, ...], at_ns: int) -> list[Event]:
    """List the events from `BEFORE_S` before the stop at ``at_ns`` to the end of the ticks."""
    watchers = (_modes, _refusals, _frames, _silences, _requests, _buses, _lateness)
    entries = sorted((event for watch in watchers for event in watch(ticks)), key=lambda event: event[0])
    return [Event((ns - at_ns) / 1e9, text) for ns, text in entries if ns - at_ns >= -BEFORE_S * 1e9]


def reports_of(ticks: Ticks) -> Iterator[StateReport]:
    """Decode the state reports of the ticks, without those that cannot be read."""
    for tick in ticks:
        with contextlib.suppress(DatagramRefused):
            if report := report_of(tick):
                yield report


def _modes(ticks: Ticks) -> Found:
    """Find changes of the mode, and of what slows the machine down."""
    for last, report in pairwise(reports_of(ticks)):
        if last.mode != report.mode:
            at_ns = report.since_ns if report.since_ns > last.stamp_ns else report.stamp_ns
            stops = report.mode in STOPPED and last.reason != report.reason
            why = f": {_name_of(report.reason)}" if stops else ""
            yield at_ns, f"mode {Mode(last.mode).name} → {Mode(report.mode).name}{why}"
        elif last.reason != report.reason and report.mode not in (Mode.BOOT, Mode.STANDBY) and report.reason & 0xFF:
            at_ns = report.since_ns if report.since_ns > last.stamp_ns else report.stamp_ns
            yield at_ns, _text_of(report.reason, report.numbers)


def _refusals(ticks: Ticks) -> Found:
    """Find setpoints that the controller refused."""
    for last, report in pairwise(reports_of(ticks)):
        if count := report.refused - last.refused & 0xFFFF:
            times = "" if count == 1 else f"{count} times, the last one: "
            yield report.stamp_ns, f"request refused: {times}{_text_of(report.refusal)}"


def _frames(ticks: Ticks) -> Found:
    """Find changes of the watched signals, and emergency messages."""
    last: dict[str, dict[str, float]] = {}
    for bus, database, (stamp_ns, key, data) in _received(ticks):
        codec = database.find(key)
        if codec is not None and codec.name in WATCHED and len(data) == codec.length:
            values = codec.named(codec.decode(data))
            now = {name: values[name] for name in WATCHED[codec.name] if name in values}
            before, last[codec.name] = last.get(codec.name, now), now
            changed = [
                f"{name} {_label(codec, name, before[name])} → {_label(codec, name, now[name])}"
                for name in now
                if now[name] != before[name]
            ]
            if changed:
                yield stamp_ns, f"{codec.name}: {', '.join(changed)}"
        elif codec is None and bus == "crane0" and (emergency := parse_emergency(key, data)):
            node = NODE_NAMES.get(emergency.node, f"node {emergency.node}")
            yield stamp_ns, f"emergency message {emergency.code:04X}h of {node}"


class _Silence:
    """Messages that stop coming for their time-out, and when they are back."""

    def __init__(self) -> None:
        self._last_ns: dict[str, int] = {}
        self._timeouts_ns: dict[str, int] = {}
        self._silent: set[str] = set()

    def came(self, name: str, stamp_ns: int, timeout_ns: int) -> Found:
        """Note that a message came."""
        if name in self._silent:
            self._silent.remove(name)
            yield stamp_ns, f"{name} back after {(stamp_ns - self._last_ns[name]) / 1e6:.0f} ms"
        self._last_ns[name], self._timeouts_ns[name] = stamp_ns, timeout_ns

    def forget(self) -> None:
        """Forget what came so far, which has ended on purpose."""
        self._last_ns.clear()
        self._silent.clear()

    def pass_time(self, now_ns: int) -> Found:
        """Find the messages that are silent now; their event is at the last one."""
        for name, last_ns in self._last_ns.items():
            if name not in self._silent and now_ns - last_ns > self._timeouts_ns[name]:
                self._silent.add(name)
                yield last_ns, f"{name} silent from here for more than {self._timeouts_ns[name] / 1e6:.0f} ms"


def _silences(ticks: Ticks) -> Found:
    """Find messages on the buses that are silent for their time-out in the DBC."""
    silence = _Silence()
    for tick in ticks:
        for _, database, (stamp_ns, key, _) in _received((tick,)):
            codec = database.find(key)
            if codec is not None and codec.timeout_ns:
                yield from silence.came(codec.name, stamp_ns, codec.timeout_ns)
        yield from silence.pass_time(tick.now_ns)


def _requests(ticks: Ticks) -> Found:
    """Find what operators send, and pauses in the planner's setpoints."""
    setpoints, beats = _Silence(), _Silence()
    for tick in ticks:
        for data in (*tick.operator, *tick.datagrams):
            try:
                message = datagrams.decode(data)
            except DatagramRefused:
                continue
            if isinstance(message, OperatorCommand):
                if message.action is OperatorAction.WATCH:  # five a second
                    yield from beats.came("heartbeats of the operator", tick.now_ns, BEAT_SILENCE_NS)
                    continue
                if message.action is OperatorAction.WATCH_END:
                    beats.forget()
                yield tick.now_ns, f"operator: {message.action.name}"
            elif isinstance(message, CraneSetpoint | DriveSetpoint | SpoolTest):
                yield from setpoints.came("setpoints of the planner", tick.now_ns, SETPOINT_SILENCE_NS)
        yield from setpoints.pass_time(tick.now_ns)
        yield from beats.pass_time(tick.now_ns)


def _buses(ticks: Ticks) -> Found:
    """Find states of the own node on each bus, and bursts of its counters."""
    buses = {"crane0": [tick.bus for tick in ticks], "mach0": [tick.machine_bus for tick in ticks]}
    times_ns = [tick.now_ns for tick in ticks]
    for name, readings in buses.items():
        for now_ns, (last, bus) in zip(times_ns[1:], pairwise(readings), strict=True):
            if last.state != bus.state:
                yield now_ns, f"{name}: {BusState(last.state).name} → {BusState(bus.state).name}"
    for name, readings in buses.items():
        for counter_name, count in COUNTERS.items():
            for begin_ns, end_ns, new in _bursts(times_ns, [count(bus) for bus in readings]):
                within = f" within {(end_ns - begin_ns) / 1e6:.0f} ms" if end_ns > begin_ns else ""
                yield begin_ns, f"{name}: {new} {counter_name}{within}"


def _bursts(times_ns: list[int], counts: list[int]) -> Iterator[list[int]]:
    """Group increments of a counter with pauses of at most `BURST_NS`: first and last time, and how many."""
    burst: list[int] = []
    for now_ns, (last, count) in zip(times_ns[1:], pairwise(counts), strict=True):
        if count <= last:
            continue
        if burst and now_ns - burst[1] <= BURST_NS:
            burst[1:] = now_ns, burst[2] + count - last
            continue
        if burst:
            yield burst
        burst = [now_ns, now_ns, count - last]
    if burst:
        yield burst


def _lateness(ticks: Ticks) -> Found:
    """Find ticks that began more than 10 ms late, and periods that were skipped."""
    for last, tick in pairwise((*ticks[:1], *ticks)):
        if tick.late_ns > LATE_NS:
            skipped = tick.missed_ticks - last.missed_ticks
            skipped_text = f", {skipped} periods skipped" if skipped else ""
            yield tick.now_ns, f"the tick began {tick.late_ns / 1e6:.1f} ms late{skipped_text}"


def _received(ticks: Ticks) -> Iterator[tuple[str, Database, tuple[int, int, bytes]]]:
    """Return every frame of the ticks with its bus and its database, of which mach0 has two."""
    crane, machine, gnss = load("crane"), load("machine"), load("gnss")
    for tick in ticks:
        yield from (("crane0", crane, frame) for frame in tick.frames_in)
        yield from (("mach0", machine if machine.find(frame[1]) else gnss, frame) for frame in tick.machine_frames_in)


def _label(codec: MessageCodec, name: str, value: Any) -> str:
    if name == "Verdict":
        return Verdict(value).name if value in set(Verdict) else f"{value:g}"
    choices = codec.signals[codec.index[name]].choices
    return choices.get(int(value)) or f"{value:g}"


def _name_of(reason: int) -> str:
    known_reason = known(reason)
    return f"reason {reason & 0xFF}" if known_reason is None else known_reason.name


def _text_of(reason: int, numbers: tuple[float, ...] = ()) -> str:
    """Write a reason on a line of the timeline: without the advice, which belongs to the stop."""
    return _name_of(reason) if known(reason) is None else f"{(e := explain(reason, numbers)).finding} [{e.code}]"
