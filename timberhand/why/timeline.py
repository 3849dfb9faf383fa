"""What happened around a stop, as a short list of events: what the controller received, decided and was late for.

Input: the tick records of a stop; output: events in order of time, of the last seconds before it and of the time after.
A message counts as silent when nothing came for its time-out in the DBC.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from machine.status.modes import Mode
from machine.status.reasons import Reason
from recorder.stop import STOPPED

BEFORE_S: Final = 2.0
"""Events of this time before the stop are listed."""
SETPOINT_SILENCE_NS: Final = 150_000_000
BEAT_SILENCE_NS: Final = 5 * WATCH_PERIOD_NS // 2
WATCHED: Final = {
    "EstopStat": ("ChannelA", "ChannelB", "Person", "Lever", "ResetReq"),
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


class Event(NamedTuple):
    """One event; ``at_s`` is relative to the stop."""

    at_s: float
    text: str


def events_of(ticks: tuple[TickRecord, ...], at_ns: int) -> list[Event]:
    """The events from `BEFORE_S` before the stop at ``at_ns`` to the end of the ticks."""
    found: list[tuple[int, str]] = []
    watchers = [_Modes(), _Refusals(), _Frames(), _Silences(), _Requests(), _Buses(), _Lateness()]
    for watcher in watchers:
        for tick in ticks:
            found += watcher.step(tick)
        found += watcher.end()
    found.sort(key=lambda event: event[0])
    return [
        Event((ns - at_ns) / 1e9, text)
        for ns, text in found
        if ns - at_ns >= -BEFORE_S * 1e9
    ]  # fmt: skip


class _Watcher:
    """Turns ticks into events (time [ns], text)."""

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        """The events that a tick shows."""
        raise NotImplementedError

    def end(self) -> Iterator[tuple[int, str]]:
        """What is left after the last tick."""
        return iter(())


class _Modes(_Watcher):
    """Changes of the mode, and of what slows the machine down."""

    def __init__(self) -> None:
        self._last: StateReport | None = None

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        report = report_of(tick)
        if report is None:
            return
        last, self._last = self._last, report
        if last is None or (last.mode, last.reason) == (report.mode, report.reason):
            return
        at_ns = report.since_ns if report.since_ns > last.stamp_ns else report.stamp_ns
        if last.mode != report.mode:
            why = ""
            if report.mode in STOPPED and last.reason != report.reason:
                why = f": {_name_of(report.reason)}"
            yield at_ns, f"mode {Mode(last.mode).name} → {Mode(report.mode).name}{why}"
        elif report.mode not in (Mode.BOOT, Mode.STANDBY) and report.reason & 0xFF:
            yield at_ns, _text_of(report.reason, report.numbers)


class _Refusals(_Watcher):
    """Setpoints that the controller refused."""

    def __init__(self) -> None:
        self._refused: int | None = None

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        report = report_of(tick)
        if report is None:
            return
        count = 0 if self._refused is None else report.refused - self._refused & 0xFFFF
        self._refused = report.refused
        if count:
            times = "" if count == 1 else f"{count} times, the last one: "
            yield report.stamp_ns, f"request refused: {times}{_text_of(report.refusal)}"


class _Frames(_Watcher):
    """Changes of the watched signals, and emergency messages."""

    def __init__(self) -> None:
        self._databases = _databases()
        self._values: dict[str, dict[str, float]] = {}

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        for database, frames in zip(self._databases, (tick.frames_in, tick.machine_frames_in), strict=True):
            for stamp_ns, key, data in frames:
                codec = database.find(key)
                if codec is not None and codec.name in WATCHED and len(data) == codec.length:
                    yield from self._changes(codec, stamp_ns, data)
                elif codec is None and database is self._databases[0] and (emergency := parse_emergency(key, data)):
                    node = NODE_NAMES.get(emergency.node, f"node {emergency.node}")
                    yield stamp_ns, f"emergency message {emergency.code:04X}h of {node}"

    def _changes(self, codec: MessageCodec, stamp_ns: int, data: bytes) -> Iterator[tuple[int, str]]:
        values = codec.named(codec.decode(data))
        now = {name: values[name] for name in WATCHED[codec.name] if name in values}
        before, self._values[codec.name] = self._values.get(codec.name, now), now
        changed = [
            f"{name} {_label(codec, name, before[name])} → {_label(codec, name, now[name])}"
            for name in now
            if now[name] != before[name]
        ]
        if changed:
            yield stamp_ns, f"{codec.name}: {', '.join(changed)}"


class _Silences(_Watcher):
    """Messages that stop coming for their time-out, and when they are back."""

    def __init__(self) -> None:
        self._databases = _databases()
        self._last_ns: dict[str, int] = {}
        self._timeouts_ns: dict[str, int] = {}
        self._silent: set[str] = set()

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        for database, frames in zip(self._databases, (tick.frames_in, tick.machine_frames_in), strict=True):
            for stamp_ns, key, _ in frames:
                codec = database.find(key)
                if codec is not None and codec.timeout_ns:
                    yield from self.came(codec.name, stamp_ns, codec.timeout_ns)
        yield from self.pass_time(tick.now_ns)

    def came(self, name: str, stamp_ns: int, timeout_ns: int) -> Iterator[tuple[int, str]]:
        """A message came."""
        if name in self._silent:
            self._silent.remove(name)
            yield stamp_ns, f"{name} back after {(stamp_ns - self._last_ns[name]) / 1e6:.0f} ms"
        self._last_ns[name], self._timeouts_ns[name] = stamp_ns, timeout_ns

    def forget(self) -> None:
        """What came so far has ended on purpose."""
        self._last_ns.clear()
        self._silent.clear()

    def pass_time(self, now_ns: int) -> Iterator[tuple[int, str]]:
        """Which messages are silent now; their event is at the last one."""
        for name, last_ns in self._last_ns.items():
            if name not in self._silent and now_ns - last_ns > self._timeouts_ns[name]:
                self._silent.add(name)
                yield last_ns, f"{name} silent from here for more than {self._timeouts_ns[name] / 1e6:.0f} ms"


class _Requests(_Watcher):
    """What operators send, and pauses in the planner's setpoints."""

    def __init__(self) -> None:
        self._setpoints, self._beats = _Silences(), _Silences()

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        for data in (*tick.operator, *tick.datagrams):
            try:
                message = datagrams.decode(data)
            except DatagramRefused:
                continue
            if isinstance(message, OperatorCommand):
                if message.action is OperatorAction.WATCH:  # five a second
                    yield from self._beats.came("heartbeats of the operator", tick.now_ns, BEAT_SILENCE_NS)
                    continue
                if message.action is OperatorAction.WATCH_END:
                    self._beats.forget()
                yield tick.now_ns, f"operator: {message.action.name}"
            elif isinstance(message, CraneSetpoint | DriveSetpoint | SpoolTest):
                yield from self._setpoints.came("setpoints of the planner", tick.now_ns, SETPOINT_SILENCE_NS)
        yield from self._setpoints.pass_time(tick.now_ns)
        yield from self._beats.pass_time(tick.now_ns)


class _Buses(_Watcher):
    """States of the own node on each bus, and bursts of its counters."""

    def __init__(self) -> None:
        self._states: dict[str, int] = {}
        self._bursts: dict[tuple[str, str], _Burst] = {}

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        for name, bus in (("crane0", tick.bus), ("mach0", tick.machine_bus)):
            before = self._states.get(name, bus.state)
            self._states[name] = bus.state
            if before != bus.state:
                yield tick.now_ns, f"{name}: {BusState(before).name} → {BusState(bus.state).name}"
            for what, count in COUNTERS.items():
                burst = self._bursts.setdefault((name, what), _Burst(count(bus)))
                yield from burst.step(count(bus), tick.now_ns, f"{name}: {{}} {what}")

    def end(self) -> Iterator[tuple[int, str]]:
        for (name, what), burst in self._bursts.items():
            yield from burst.end(f"{name}: {{}} {what}")


class _Burst:
    """Increments of a counter, with pauses shorter than `BURST_NS`."""

    def __init__(self, count: int) -> None:
        self._count, self._new, self._begin_ns, self._last_ns = count, 0, 0, 0

    def step(self, count: int, now_ns: int, text: str) -> Iterator[tuple[int, str]]:
        if self._new and now_ns - self._last_ns > BURST_NS:
            yield from self.end(text)
        if count > self._count:
            self._begin_ns = self._begin_ns if self._new else now_ns
            self._new += count - self._count
            self._last_ns = now_ns
        self._count = count

    def end(self, text: str) -> Iterator[tuple[int, str]]:
        """The burst that is not reported yet."""
        if self._new:
            lasted_ms = (self._last_ns - self._begin_ns) / 1e6
            yield self._begin_ns, text.format(self._new) + (f" within {lasted_ms:.0f} ms" if lasted_ms else "")
            self._new = 0


class _Lateness(_Watcher):
    """Ticks that began more than 10 ms late, and periods that were skipped."""

    def __init__(self) -> None:
        self._missed: int | None = None

    def step(self, tick: TickRecord) -> Iterator[tuple[int, str]]:
        skipped = 0 if self._missed is None else tick.missed_ticks - self._missed
        self._missed = tick.missed_ticks
        if tick.late_ns > LATE_NS:
            more = f", {skipped} periods skipped" if skipped else ""
            yield tick.now_ns, f"the tick began {tick.late_ns / 1e6:.1f} ms late{more}"


def report_of(tick: TickRecord) -> StateReport | None:
    """The state report of a tick; None without one."""
    if not tick.report:
        return None
    try:
        report = datagrams.decode(tick.report)
    except DatagramRefused:
        return None
    return report if isinstance(report, StateReport) else None


def _databases() -> tuple[Database, Database]:
    return load("crane"), load("machine")


def _label(codec: MessageCodec, name: str, value: Any) -> str:
    if name == "Verdict":
        return Verdict(value).name if value in set(Verdict) else f"{value:g}"
    choices = codec.signals[codec.index[name]].choices
    return choices.get(int(value)) or f"{value:g}"


def _name_of(reason: int) -> str:
    number = reason & 0xFF
    return Reason(number).name if number in set(Reason) else f"reason {number}"


def _text_of(reason: int, numbers: tuple[float, ...] = ()) -> str:
    """A reason on a line of the timeline: without the advice, which belongs to the stop."""
    if reason & 0xFF not in set(Reason):
        return _name_of(reason)
    found = explain(reason, numbers)
    measured = ", ".join(quantity.text for quantity in found.quantities)
    return f"{found.sentence[:-1]}{f' ({measured})' if measured else ''} [{found.code}]"
