"""The status of the installed services: systemd's state of each unit, and the controller's timing page.

Read-only, for any user.  `read_status` returns everything; its ``named`` is the JSON of ``service status``, and
`screen` shows it on a terminal of 60 columns or more.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from can_dbc.timing.durations import Durations
from can_dbc.timing.page import Facts, InputAge, Timing, default_path, read_timing
from host.exit_codes import ExitCode
from host.systemd import last_journal_line, show_all
from runtime.errors import InputRefused

NAMES: Final = (
    "controller",
    "guard",
    "perception",
    "autonomy",
    "recorder",
    "console",
    "plc",
    "can@crane0",
    "can@mach0",
    "update",
)
PROPERTIES: Final = (
    "Id",
    "Type",
    "LoadState",
    "ActiveState",
    "SubState",
    "Result",
    "ExecMainStatus",
    "NRestarts",
    "StatusText",
    "StateChangeTimestampMonotonic",
    "ExecMainExitTimestampMonotonic",
)
SYSTEMD: Final = Path("/run/systemd/system")
SERVICE_PAGE: Final = Path("/run/timberhand/controller.timing")
ENDINGS: Final = {
    "success": "",
    "signal": "killed by signal {}",
    "watchdog": "hung, ended by the watchdog",
    "timeout": "timeout of starting or stopping",
}
"""In words, by systemd's result; another result is its own word."""
STALE_NS: Final = 3_000_000_000
"""The page is written once per second; at this age the controller hangs or has ended."""
STATE_STYLES: Final = {"running": "green", "done": "green", "failed": "bold red", "restarting": "bold red"}
MODE_STYLES: Final = {"FAULT": "bold red", "STOP": "bold red", "ACTIVE": "bold green", "ARMED": "bold green"}
TABLE_ROWS: Final = {
    "wake": "wake-up late",
    "sync": "SYNC late",
    "tick": "tick",
    "cpu": "tick, CPU",
    "sample_to_command": "sample to command",
}
"""Durations with a row of their own; the stages of the tick share a line."""
INPUT_COUNT: Final = 4
"""Number of inputs shown, the oldest first; the JSON has all of them."""


@dataclass(frozen=True, slots=True)
class Unit:
    """One service.

    ``state`` is one of running, starting, ending, done (a one-shot that succeeded), stopped, failed, restarting, not
    configured, not installed.  ``why`` tells how it ended if it failed; ``since_s`` is the time in this state.
    """

    name: str
    state: str
    why: str
    since_s: float | None
    restarts: int
    words: str


@dataclass(frozen=True, slots=True)
class Status:
    """Units and timing; ``notes`` are sentences about what is unavailable."""

    units: tuple[Unit, ...]
    timing: Timing | None
    notes: tuple[str, ...]

    @property
    def silent(self) -> bool:
        """Whether the controller writes no timing page, or has stopped writing it."""
        return self.timing is None or self.timing.age_ns > STALE_NS

    def named(self) -> dict[str, Any]:
        """Return the status as plain values for JSON."""
        timing = None
        if self.timing is not None:
            timing = self.timing.named() | {"age_ns": self.timing.age_ns, "silent": self.silent}
        return {"units": [asdict(unit) for unit in self.units], "timing": timing, "notes": list(self.notes)}


def read_status(page: Path | None = None) -> Status:
    """Read the status now; ``page`` is the controller's timing page (default: the service's, else this user's)."""
    notes = []
    units: tuple[Unit, ...] = ()
    if SYSTEMD.is_dir():
        names = [f"timberhand-{name}.service" for name in NAMES]
        units = tuple(read_unit(properties, time.monotonic()) for properties in show_all(names, *PROPERTIES))
    else:
        notes.append("systemd does not run here, so no service is shown.")
    timing = None
    try:
        timing = read_timing(page or (SERVICE_PAGE if SERVICE_PAGE.exists() else default_path()))
    except InputRefused as refused:
        notes.append(str(refused))
    return Status(units, timing, tuple(notes))


def read_unit(found: dict[str, str], now_s: float) -> Unit:
    """Read a unit from its systemd properties; ``now_s`` is the monotonic clock."""
    name = found["Id"].removeprefix("timberhand-").removesuffix(".service")
    state = _state(found)
    changed_s = int(found.get("StateChangeTimestampMonotonic") or 0) * 1e-6
    ended = state in ("failed", "restarting", "stopped")
    why = ending(found.get("Result", ""), found.get("ExecMainStatus") or "0") if ended else ""
    status_text = found.get("StatusText", "")
    if state in ("failed", "restarting") and not status_text:
        status_text = last_journal_line(found["Id"])
    since_s = now_s - changed_s if changed_s else None
    return Unit(name, state, why, since_s, int(found.get("NRestarts") or 0), status_text)


def _state(found: dict[str, str]) -> str:
    active = found.get("ActiveState", "")
    if found.get("LoadState") == "not-found":
        return "not installed"
    if found.get("SubState") == "auto-restart":
        return "restarting"
    if active == "inactive" and found.get("Result") == "exec-condition":
        return "not configured"
    if active == "inactive" and found.get("Result") == "success" and found.get("ExecMainExitTimestampMonotonic") != "0":
        return "done" if found.get("Type") == "oneshot" else "stopped"
    state_names = {"active": "running", "activating": "starting", "deactivating": "ending", "inactive": "stopped"}
    return state_names.get(active, active)


def ending(result: str, status: str) -> str:
    """Say how a service ended, from systemd's result and the exit status or signal of its main process."""
    if result == "exit-code":
        known = status.isdecimal() and int(status) in set(ExitCode)
        return f"exit status {status}" + (f", {ExitCode(int(status)).words}" if known else "")
    return ENDINGS.get(result, result).format(status)


def oldest_first(inputs: Sequence[tuple[str, InputAge]]) -> list[tuple[str, InputAge]]:
    """Sort inputs by the longest age at which they were used."""
    return sorted(inputs, key=lambda item: -item[1].longest_ns)


def screen(now: Status, before: Timing | None = None) -> RenderableType:
    """Draw the whole screen; with an earlier page ``before`` also the changes since."""
    parts: list[RenderableType] = []
    if now.units:
        parts += [_units(now.units), Text()]
    if now.timing is not None:
        if before is not None and before.facts.started_ns != now.timing.facts.started_ns:
            before = None  # of an earlier process
        parts += _timing(now.timing, before, now.silent)
    parts += [Text(note, style="yellow") for note in now.notes]
    return Group(*parts)


def _table(*columns: str, title: str = "", words: int = 1) -> Table:
    """Make a plain table; all columns but the first ``words`` hold numbers."""
    table = Table(
        title=title or None, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 1)
    )
    for i, name in enumerate(columns):
        table.add_column(name, justify="left" if i < words else "right", no_wrap=i >= words, header_style="dim")
    return table


def _units(units: tuple[Unit, ...]) -> Table:
    table = _table("service", "since", "restarts")
    table.add_column("", overflow="fold", ratio=1)
    for unit in units:
        state = Text(unit.state, style=STATE_STYLES.get(unit.state, "yellow"))
        if unit.why:
            state.append(f" ({unit.why})")
        if unit.words:
            state.append(f": {unit.words}", style="default")
        since = "" if unit.since_s is None else duration(unit.since_s)
        table.add_row(unit.name, since, str(unit.restarts or ""), state)
    return table


def _timing(timing: Timing, before: Timing | None, silent: bool) -> list[RenderableType]:
    facts = timing.facts
    head = Text.assemble(
        "controller ",
        (facts.mode, MODE_STYLES.get(facts.mode, "bold")),
        f", {1e9 / facts.period_ns:.0f} Hz for {duration((facts.written_ns - facts.started_ns) * 1e-9)}",
        f", process {facts.pid}, tick: {facts.tick}",
    )
    parts: list[RenderableType] = [head, Text(facts.words)]
    if silent:
        parts.append(
            Text(f"no update for {duration(timing.age_ns * 1e-9)}: the controller hangs or has ended", style="bold red")
        )
    counters = _counters(facts, before.facts if before else None)
    for part in (counters, _durations(timing, before), _inputs(facts), _buses(facts), _process(facts, before)):
        parts += [Text(), part]
    return [*parts, Text()] if silent else parts


def _counters(facts: Facts, before: Facts | None) -> Text:
    def count(name: str, of: Callable[[Facts], int], bad: bool) -> tuple[str, str]:
        grown = f" (+{number(of(facts) - of(before))})" if before else ""
        wrong = bad and (of(facts) - of(before) if before else of(facts))
        return f"{name} {number(of(facts))}{grown}", "bold yellow" if wrong else ""

    return Text.assemble(
        count("ticks", lambda f: f.ticks, False),
        " · ",
        count("missed", lambda f: f.missed, True),
        " · ",
        count("late", lambda f: f.late, True),
    )


def _durations(timing: Timing, before: Timing | None) -> RenderableType:
    columns = ["µs", "p50", "p99", "p99.9", "max"]
    table = _table(*columns, *(["now p99", "now max"] if before else []))
    for name, word in TABLE_ROWS.items():
        distribution = timing.durations[name]
        if not distribution.count:
            continue
        row = [*(_us(distribution, share) for share in (0.5, 0.99, 0.999)), number(distribution.longest_ns // 1000)]
        if before:
            recent = distribution - before.durations[name]
            row += [_us(recent, 0.99), number(recent.longest_ns // 1000)] if recent.count else ["", ""]
        table.add_row(word, *row)
    stages = [
        f"{n} {_us(distribution, 0.99)}"
        for n, distribution in timing.durations.items()
        if n not in TABLE_ROWS and distribution.count
    ]
    return Group(table, Text("stages of the tick, p99: " + ", ".join(stages))) if stages else table


def _us(found: Durations, share: float) -> str:
    return number(found.quantile_ns(share) // 1000)


def _inputs(facts: Facts) -> RenderableType:
    used = [item for item in oldest_first(list(facts.inputs.items())) if item[1].count]
    if not used:
        return Text("no input received yet", style="yellow")
    table = _table("age of inputs when used, ms", "last", "worst", "used")
    for name, age in used[:INPUT_COUNT]:
        table.add_row(name, f"{age.newest_ns * 1e-6:.1f}", f"{age.longest_ns * 1e-6:.1f}", number(age.count))
    if len(used) > INPUT_COUNT:
        table.add_row(Text(f"{len(used) - INPUT_COUNT} younger ones", style="dim"))
    refused = [(name, age.refused) for name, age in facts.inputs.items() if age.refused]
    renderables: list[RenderableType] = [table]
    if refused:
        counts = ", ".join(f"{name} {number(count)}" for name, count in sorted(refused, key=lambda item: -item[1]))
        renderables.append(Text(f"refused frames (length, checksum, counter or value): {counts}", style="yellow"))
    silent = sorted(name for name, age in facts.inputs.items() if not age.count)
    if silent:
        renderables.append(Text(f"never received: {', '.join(silent)}", style="yellow"))
    return Group(*renderables)


def _buses(facts: Facts) -> Table:
    table = _table("bus", "state", "received", "sent", "refused", "dropped", "errors", words=2)
    for bus in facts.buses:
        state = Text(bus.state, style="green" if bus.state == "ACTIVE" else "bold red")
        if bus.recoveries:
            state.append(f", back {bus.recoveries}\N{MULTIPLICATION SIGN}", style="yellow")
        counts = (bus.refused, bus.dropped, bus.error_frames)
        table.add_row(bus.name, state, _rounded(bus.received), _rounded(bus.sent), *map(number, counts))
    return table


def _process(facts: Facts, before: Timing | None) -> Text:
    process = facts.process
    since_ns, cpu_ns = facts.written_ns - facts.started_ns, process.cpu_ns
    minor, major = process.minor_faults, process.major_faults
    faults = f"page faults {number(minor)} minor, {number(major)} major"
    if before:
        prior = before.facts.process
        since_ns, cpu_ns = facts.written_ns - before.facts.written_ns, cpu_ns - prior.cpu_ns
        faults = f"page faults +{number(minor - prior.minor_faults)} minor, +{number(major - prior.major_faults)} major"
    share = 100.0 * cpu_ns / since_ns if since_ns > 0 else 0.0
    figures = (
        f"memory {process.resident_kb / 1024:.0f} MB",
        f"CPU {share:.1f} %",
        faults,
        f"preempted {number(process.involuntary_switches)} times",
        f"garbage passes {number(process.gc_runs)}",
    )
    return Text(" · ".join(figures))


def number(value: int) -> str:
    """Group by thousands: 1 234 567."""
    return f"{value:,}".replace(",", "\N{NO-BREAK SPACE}")


def _rounded(value: int) -> str:
    """Round to four digits from a million on: 12.35 M."""
    if value < 1_000_000:
        return number(value)
    text = f"{value / 1e6:.2f} M" if value < 1_000_000_000 else f"{value / 1e9:.2f} G"
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def duration(seconds: float) -> str:
    """Write a duration in its two largest units: 2 h 13 min."""
    if seconds < 10.0:
        return f"{max(seconds, 0.0):.1f} s"
    s = round(seconds)
    for size, unit, small, small_unit in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if s >= size:
            return f"{s // size} {unit} {s % size // small} {small_unit}"
    return f"{s} s"
