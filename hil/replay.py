"""Replays a recorded run: the controller's inputs of every tick go into `controller.step` again, outputs are compared.

Input is a run's directory or one ``run.mcap``; the profile, the DBC and every input come from the record.  The same
code gives the same bytes, so the first tick that differs is where today's controller decides otherwise than the one
that was recorded.  State cannot be followed over ticks that are missing: a replay ends there and says so.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Final

import msgspec

from can_dbc import setpoint, tick_record
from can_dbc.canopen import Wire
from can_dbc.codec import Database, load, resolve
from can_dbc.frame import describe
from can_dbc.tick_record import RecordRefused, TickRecord
from controller.config import ConfigError, Settings
from controller.config import load as load_settings
from controller.record import refill, said
from controller.step import Controller, Inputs, step
from host.exits import Exit, Stopped
from recorder.manifest import Manifest
from recorder.mcap_scan import Channel, NotMcap, Stored, scan
from recorder.recorder import TICK
from recorder.recover import recover, run_files

_Said = tuple[Sequence[Wire], Sequence[Wire], bytes, bytes]
"""Frames on crane0, frames on mach0, report."""
_FIRST: Final = 64
"""Ticks from which the control rate is told."""


@dataclass(slots=True)
class Result:
    """What a replay found: ``ticks`` agree; ``missing`` or ``difference`` says why it ended before ``total``."""

    ticks: int = 0
    total: int = 0
    profile: str = ""
    profile_hash: str = ""
    rate_hz: int = 0
    missing: str = ""
    difference: dict[str, Any] = field(default_factory=dict)

    @property
    def agrees(self) -> bool:
        """True only when every recorded tick was replayed to the same bytes."""
        return self.ticks == self.total > 0 and not self.missing and not self.difference

    def as_dict(self) -> dict[str, Any]:
        """The result for JSON."""
        return asdict(self) | {"agrees": self.agrees}


def files_of(log: Path) -> list[Path]:
    """The MCAP files of a run's directory, or the one file; a directory is mended first.

    Raises:
        Stopped: there is no recording.
    """
    if log.is_dir():
        with contextlib.suppress(OSError):  # a directory that cannot be written is read as it is
            recover(log)
        files = run_files(log)
    else:
        files = [log] if log.is_file() else []
    if not files:
        raise Stopped(Exit.CONFIGURATION, f"{log} holds no recording; give a run's directory or its run.mcap")
    return files


def messages(files: list[Path], topic: str) -> Iterator[bytes]:
    """The payloads of a topic in the order of recording; raises Stopped."""
    try:
        for path in files:
            for record in scan(path, {topic}):
                if isinstance(record, Stored):
                    yield record.data
    except NotMcap as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from error


def contents(files: list[Path]) -> dict[str, int]:
    """Topic -> number of messages, for topics that have any; raises Stopped."""
    counts: Counter[str] = Counter()
    try:
        for path in files:
            topics: dict[int, str] = {}
            for record in scan(path):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Stored):
                    counts[topics[record.channel_id]] += 1
    except NotMcap as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from error
    return dict(sorted(counts.items()))


def manifest_of(files: list[Path]) -> Manifest:
    """The manifest that the recording carries in itself; raises Stopped."""
    first = next(messages(files[:1], "/manifest"), None)
    if first is None:
        raise Stopped(Exit.CONFIGURATION, f"{files[0]} has no manifest, so it is no recording of ours")
    return msgspec.json.decode(first, type=Manifest)


def settings_for(manifest: Manifest, ticks: list[TickRecord], profile: str | None, key: bytes | None) -> Settings:
    """The controller's settings of the recorded run: its profile, checked by hash, and its rate.

    Raises:
        Stopped: profile or DBC are not the recorded ones.
    """
    try:
        settings = load_settings(profile or manifest.profile, _rate_hz(ticks), key)
    except ConfigError as error:
        hint = "" if profile else f"; name the recorded profile {manifest.profile} with --profile FILE"
        raise Stopped(Exit.CONFIGURATION, f"{error}{hint}") from error
    now = f"{settings.profile_hash:08x}"
    if now != manifest.profile_hash:
        raise Stopped(
            Exit.CONFIGURATION,
            f"profile {settings.profile.name} has hash {now}, the recording was made with {manifest.profile_hash}; "
            "name the profile of that time with --profile FILE",
        )
    for name, recorded in manifest.dbc_hash.items():
        today = hashlib.sha256(resolve(name).read_bytes()).hexdigest()
        if today != recorded:
            raise Stopped(
                Exit.CONFIGURATION,
                f"{name}.dbc has hash {today[:12]}, the recording was made with {recorded[:12]}; "
                "replay it with the release that made it",
            )
    return settings


def replay(
    files: list[Path],
    profile: str | None = None,
    key: bytes | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Result:
    """Replay every tick until the first difference or gap; ``progress`` gets ticks done and the total.

    Raises:
        Stopped: no recording, or one of another profile or DBC.
    """
    manifest = manifest_of(files)
    first = list(islice(_ticks(files), _FIRST))
    settings = settings_for(manifest, first, profile, key)
    result = Result(
        total=sum(1 for _ in messages(files, TICK)),
        profile=settings.profile.name,
        profile_hash=manifest.profile_hash,
        rate_hz=settings.rate_hz,
        missing=_beginning(first, key),
    )
    if result.missing:
        return result
    controller, inputs = Controller(settings), Inputs()
    before: TickRecord | None = None
    for tick in _ticks(files):
        if before and (lost := _lost(before, tick, settings.period_ns)):
            result.missing = (
                f"{lost} ticks are missing after tick {result.ticks - 1} ({_seconds(first[0], before)}); a replay "
                "cannot follow the state over a gap"
            )
            return result
        refill(inputs, tick)
        replayed = said(step(controller, inputs, tick.now_ns))
        if replayed != (recorded := (tick.frames_out, tick.machine_frames_out, tick.report, tick.vehicle_report)):
            at = {"tick": result.ticks, "at": _seconds(first[0], tick), "now_ns": tick.now_ns}
            result.difference = at | _difference(recorded, replayed, key)
            return result
        result.ticks += 1
        before = tick
        progress(result.ticks, result.total)
    return result


def _ticks(files: list[Path]) -> Iterator[TickRecord]:
    try:
        for data in messages(files, TICK):
            yield tick_record.decode(data)
    except RecordRefused as error:
        raise Stopped(
            Exit.CONFIGURATION, f"{files[0].parent}: {error}; replay it with the release that made it"
        ) from error


def _rate_hz(ticks: list[TickRecord]) -> int:
    """The control rate, from the commonest distance of two ticks; 0 (the profile's rate) when there is only one."""
    steps = Counter((b.now_ns - a.now_ns) // (1 + b.missed_ticks - a.missed_ticks) for a, b in pairwise(ticks))
    commonest = max(steps, key=lambda step_ns: steps[step_ns], default=0)
    return round(1e9 / commonest) if commonest > 0 else 0


def _beginning(ticks: list[TickRecord], key: bytes | None) -> str:
    """What is missing at the beginning: the controller's first tick sends its report number 1."""
    if not ticks:
        return "the recording holds no tick of the controller"
    try:
        report = setpoint.decode(ticks[0].report, key) if ticks[0].report else None
    except setpoint.DatagramRefused as error:
        raise Stopped(
            Exit.CONFIGURATION, f"the recorded reports cannot be read ({error}); give the run's key with --key-file"
        ) from error
    if report is None or report.sequence != 1:
        return "the first ticks of the controller are missing; a replay needs them from the start"
    return ""


def _lost(a: TickRecord, b: TickRecord, period_ns: int) -> int:
    """Records that should stand between two; a tick the controller itself skipped is none."""
    return max(0, (b.now_ns - a.now_ns) // period_ns - 1 - (b.missed_ticks - a.missed_ticks))


def _seconds(first: TickRecord, tick: TickRecord) -> str:
    return f"{(tick.now_ns - first.now_ns) / 1e9:.3f} s"


def _difference(recorded: _Said, replayed: _Said, key: bytes | None) -> dict[str, list[str]]:
    """What was said on either side, in words, without what was said on both."""
    databases = load("crane"), load("machine")
    lines = []
    for crane, machine, *reports in (recorded, replayed):
        spoken = [_words(databases[0], *frame) for frame in crane] + [_words(databases[1], *frame) for frame in machine]
        lines.append(spoken + [line for report in reports for line in _report_words(report, key)])
    before, now = lines
    return {
        "recorded": [line for line in before if line not in now] or before,
        "replayed": [line for line in now if line not in before] or now,
    }


def _words(database: Database, key: int, data: bytes) -> str:
    codec = database.find(key)
    raw = f"{describe(key)}#{data.hex().upper()}"
    if codec is None or len(data) != codec.length:
        return raw
    values = codec.named(codec.decode(data))
    return f"{raw} {codec.name} " + " ".join(f"{name}={value:g}" for name, value in values.items())


def _report_words(report: bytes, key: bytes | None) -> list[str]:
    if not report:
        return []
    try:
        return [str(setpoint.decode(report, key))]
    except setpoint.DatagramRefused:
        return [f"report {report.hex()}"]
