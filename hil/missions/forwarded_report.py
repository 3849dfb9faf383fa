"""The report of a run to the forest company: the forwarded loads as StanForD 2010 ``fpr``, beside the recording."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Final

from autonomy.manager.tally import Load
from autonomy.missions.fpr import ForwardedLoad, ForwardedLog, Forwarder, write_fpr
from autonomy.missions.model import ForwardingMission
from machine.profile import Profile

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
            tuple(ForwardedLog(x.position, when(x.at_ns), x.volume_m3, assortment=x.assortment) for x in load.logs),
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
