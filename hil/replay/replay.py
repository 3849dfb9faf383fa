"""Replays a recorded run: `controller.step` gets the recorded inputs of every tick, and its outputs are compared.

Input is a run's directory or one ``run.mcap``; the profile, the DBC and every input come from the recording.  The same
code gives the same bytes, so the first tick that differs is where today's controller decides differently.  The state
cannot be reconstructed across missing ticks: a replay ends there and reports them.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Final

from can_dbc.dbc.codec import Database, load, resolve
from can_dbc.frame import RawFrame, describe
from can_dbc.messages import datagrams, tick_record
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.tick_record import TickRecord
from controller.config import Settings
from controller.config import load as load_settings
from controller.process.tick_recording import restore_inputs, transmitted
from controller.step import Controller, step
from controller.tick import Inputs
from hil.replay.recording import PROFILE_FILE, manifest_of, messages
from host.exit_codes import CommandFailed, ExitCode
from recorder.manifest import Manifest
from recorder.recorder import TICK
from runtime.errors import ConfigError, InputRefused

# -- Describes how the recorded and the replayed outputs of a tick differ.


Outputs = tuple[Sequence[RawFrame], Sequence[RawFrame], bytes, bytes]
"""Frames on crane0, frames on mach0, crane report, vehicle report."""


def differing_lines(recorded: Outputs, replayed: Outputs) -> dict[str, list[str]]:
    """Describe the outputs of either side in words, without the lines that both have."""
    databases = load("crane"), load("machine")
    lines = []
    for crane, machine, *reports in (recorded, replayed):
        described = [_frame_text(databases[0], *frame) for frame in crane] + [
            _frame_text(databases[1], *frame) for frame in machine
        ]
        lines.append(described + [line for report in reports for line in _report_text(report)])
    before, now = lines
    return {
        "recorded": [line for line in before if line not in now] or before,
        "replayed": [line for line in now if line not in before] or now,
    }


def _frame_text(database: Database, key: int, data: bytes) -> str:
    codec = database.find(key)
    raw = f"{describe(key)}#{data.hex().upper()}"
    if codec is None or len(data) != codec.length:
        return raw
    values = codec.named(codec.decode(data))
    return f"{raw} {codec.name} " + " ".join(f"{name}={value:g}" for name, value in values.items())


def _report_text(report: bytes) -> list[str]:
    if not report:
        return []
    try:
        return [str(datagrams.decode(report))]
    except DatagramRefused:
        return [f"report {report.hex()}"]


# -- Replays a recorded run


_RATE_TICKS: Final = 64
"""Ticks that determine the control rate."""


@dataclass(slots=True)
class Result:
    """The result of a replay: ``ticks`` agree; ``missing`` or ``difference`` tells why it ended before ``total``."""

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
        """Return the result for JSON."""
        return asdict(self) | {"agrees": self.agrees}


def settings_for(manifest: Manifest, ticks: list[TickRecord], profile: str | None) -> Settings:
    """Return the controller's settings of the recorded run: its profile, checked by hash, and its rate.

    Raises:
        CommandFailed: profile or DBC differ from the recorded ones.
    """
    try:
        settings = load_settings(profile or manifest.profile, _rate_hz(ticks))
    except ConfigError as error:
        hint = "" if profile else f"; name the recorded profile {manifest.profile} with --profile FILE"
        raise CommandFailed("replay.profile", f"{error}{hint}", ExitCode.CONFIGURATION) from error
    now = f"{settings.profile_hash:08x}"
    if now != manifest.profile_hash:
        raise CommandFailed(
            "replay.other-profile",
            f"profile {settings.profile.name} has hash {now}, the recording was made with {manifest.profile_hash}; "
            "name the profile of that run with --profile FILE",
            ExitCode.CONFIGURATION,
        )
    for name, recorded in manifest.dbc_hash.items():
        today = hashlib.sha256(resolve(name).read_bytes()).hexdigest()
        if today != recorded:
            raise CommandFailed(
                "replay.other-dbc",
                f"{name}.dbc has hash {today[:12]}, the recording was made with {recorded[:12]}; "
                "replay it with the release that recorded it",
                ExitCode.CONFIGURATION,
            )
    return settings


def profile_beside(files: list[Path]) -> str | None:
    """Find the ``profile.toml`` that lies with a recording, for machines whose profile has changed since."""
    beside = files[0].parent / PROFILE_FILE
    return str(beside) if beside.is_file() else None


def replay(
    files: list[Path],
    profile: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Result:
    """Replay every tick until the first difference or gap; ``progress`` gets ticks done and the total.

    Raises:
        CommandFailed: no recording, or one of another profile or DBC.
    """
    manifest = manifest_of(files)
    first = list(islice(recorded_ticks(files), _RATE_TICKS))
    settings = settings_for(manifest, first, profile or profile_beside(files))
    result = Result(
        total=sum(1 for _ in messages(files, TICK)),
        profile=settings.profile.name,
        profile_hash=manifest.profile_hash,
        rate_hz=settings.rate_hz,
        missing=_missing_start(first),
    )
    if result.missing:
        return result
    controller, inputs = Controller(settings), Inputs()
    before: TickRecord | None = None
    for tick in recorded_ticks(files):
        if before and (lost := _missing_between(before, tick, settings.period_ns)):
            result.missing = (
                f"{lost} ticks are missing after tick {result.ticks - 1} ({_seconds(first[0], before)}); a replay "
                "cannot continue across a gap"
            )
            return result
        restore_inputs(inputs, tick)
        replayed = transmitted(step(controller, inputs, tick.now_ns))
        if replayed != (recorded := (tick.frames_out, tick.machine_frames_out, tick.report, tick.vehicle_report)):
            at = {"tick": result.ticks, "at": _seconds(first[0], tick), "now_ns": tick.now_ns}
            result.difference = at | differing_lines(recorded, replayed)
            return result
        result.ticks += 1
        before = tick
        progress(result.ticks, result.total)
    return result


def recorded_ticks(files: list[Path]) -> Iterator[TickRecord]:
    """Yield the tick records of a recording, in order; raises CommandFailed."""
    try:
        for data in messages(files, TICK):
            yield tick_record.decode(data)
    except InputRefused as error:
        raise CommandFailed(
            "recording.other-version",
            f"{files[0].parent}: {error}; replay it with the release that recorded it",
            ExitCode.CONFIGURATION,
        ) from error


def _rate_hz(ticks: list[TickRecord]) -> int:
    """Find the control rate from the commonest distance of two ticks; 0 (the profile's rate) when there is only one."""
    steps = Counter((b.now_ns - a.now_ns) // (1 + b.missed_ticks - a.missed_ticks) for a, b in pairwise(ticks))
    commonest = max(steps, key=lambda step_ns: steps[step_ns], default=0)
    return round(1e9 / commonest) if commonest > 0 else 0


def _missing_start(ticks: list[TickRecord]) -> str:
    """Tell what is missing at the start; empty when the first tick is there, which sends report number 1."""
    if not ticks:
        return "the recording holds no tick of the controller"
    try:
        report = datagrams.decode(ticks[0].report) if ticks[0].report else None
    except DatagramRefused as error:
        raise CommandFailed(
            "recording.reports-unreadable",
            f"the recorded reports cannot be read ({error}); read it with the release that recorded it",
            ExitCode.CONFIGURATION,
        ) from error
    if report is None or report.sequence != 1:
        return "the first ticks of the controller are missing; a replay needs them from the start"
    return ""


def _missing_between(a: TickRecord, b: TickRecord, period_ns: int) -> int:
    """Count the records missing between two ticks; ticks that the controller itself missed do not count."""
    return max(0, (b.now_ns - a.now_ns) // period_ns - 1 - (b.missed_ticks - a.missed_ticks))


def _seconds(first: TickRecord, tick: TickRecord) -> str:
    return f"{(tick.now_ns - first.now_ns) / 1e9:.3f} s"
