"""The outcome of a mission, the same live and in lockstep."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Final

from rich.console import Console

from autonomy.manager.tally import Load
from autonomy.missions.fpr import ForwardedLoad, ForwardedLog, Forwarder, write_fpr
from autonomy.missions.model import ForwardingMission
from host.exit_codes import ExitCode
from machine.profile import Profile


@dataclass(frozen=True, slots=True)
class MissionSummary:
    """The outcome of a mission; ``in_bunk`` comes from the plant's physics, the rest from manager and controller."""

    finished: bool
    failure: str
    logs: int
    in_bunk: int
    loaded: int
    given_up: dict[int, str]
    seconds: float
    driven_m: float
    stops: int
    refused: int
    states: tuple[tuple[float, str], ...]
    directory: str
    remarks: tuple[str, ...] = ()
    """What the machine found out about its load against its expectation, in words."""

    @property
    def exit_code(self) -> ExitCode:
        """`ExitCode.OK` when the mission is finished and every log reported as loaded lies in the bunk."""
        if self.finished and self.in_bunk == self.loaded:
            return ExitCode.OK
        return ExitCode.SAFETY_STOP if self.stops else ExitCode.FIGURE_MISSED

    def show(self, console: Console) -> None:
        """Print it for a person."""
        mark = "[green]✔[/green]" if self.exit_code is ExitCode.OK else "[red]✘[/red]"
        end = "The mission is finished" if self.finished else f"The mission ended early: {self.failure}"
        console.print(f"{mark} {end}. {self.in_bunk} of {self.logs} logs lie in the bunk.", highlight=False)
        for number, why in self.given_up.items():
            console.print(f"  log {number} skipped: {why}", highlight=False, soft_wrap=True)
        for text in self.remarks:
            console.print(f"  {text}", highlight=False, soft_wrap=True)
        console.print(
            f"  {self.seconds:.0f} s, {self.driven_m:.0f} m, {self.stops} stops, {self.refused} setpoints refused",
            highlight=False,
        )
        console.print(f"  recording: {self.directory}", highlight=False, soft_wrap=True)
        if self.stops:
            console.print(f"  why it stopped: timberhand why {self.directory}", highlight=False, soft_wrap=True)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        path.write_text(json.dumps(asdict(self), indent=2) + "\n")


# -- The report of a run to the forest company: the forwarded loads as StanForD 2010 ``fpr``, beside the recording.

NAME: Final = "forwarded.fpr"


def report_loads(
    directory: Path, loads: Sequence[Load], mission: ForwardingMission, profile: Profile, epoch: datetime, epoch_ns: int
) -> Path | None:
    """Write the report and return its path; None when nothing was forwarded.

    ``epoch`` (with time zone) is the date at ``epoch_ns`` on the clock of the loads.
    """
    if not loads:
        return None

    def when(at_ns: int) -> datetime:
        return (epoch + timedelta(microseconds=(at_ns - epoch_ns) // 1000)).astimezone(UTC)

    forwarded = [
        ForwardedLoad(
            tuple(
                ForwardedLog(x.position, when(x.at_ns), x.volume_m3, x.species, x.assortment, x.product_key)
                for x in load.logs
            ),
            mission.landings[load.landing],
            when(load.at_ns),
            load.driven_m,
        )
        for load in loads
    ]
    who = Forwarder(profile.name, profile.title, mission.name)
    path = directory / NAME
    path.write_bytes(write_fpr(forwarded, who, forwarded[-1].unloaded, f"timberhand {version('timberhand')}"))
    return path
