"""A recorded run made of reports: 60 s of a moving joint, with a stop after 40 s."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.console.state_reports import at

PROFILE = load_profile("palms_471")
BEGIN_NS, STOP_S, LENGTH_S = 5_000 * 10**9, 40, 60
PERIOD_NS = 20_000_000


def report_at(stamp_ns: int) -> StateReport:
    seconds = (stamp_ns - BEGIN_NS) / 1e9
    stopped = seconds >= STOP_S
    q = (0.01 * min(seconds, STOP_S), 0.4, -1.6, 0.5, 0.0)
    reference = (q[0] + 0.01, *q[1:])
    mode, reason = (Mode.STOP, pack(Reason.JOINT_STUCK, 1)) if stopped else (Mode.ACTIVE, 0)
    since_ns, numbers = (BEGIN_NS + STOP_S * 10**9, (0.4, 0.1, 0.0)) if stopped else (0, ())
    changes = {"reference": reference, "velocity": (0.01, 0.0, 0.0, 0.0, 0.0), "reason": reason}
    return at(q, stamp_ns, mode, since_ns=since_ns, numbers=numbers, **changes)


class RecordedRun:
    """`console.replay.Recording` without a file."""

    begin_ns, end_ns, buses = BEGIN_NS, BEGIN_NS + LENGTH_S * 10**9, (PROFILE.crane_bus,)

    def reports(self, begin_ns: int, end_ns: int) -> Iterator[StateReport]:
        first = max(begin_ns, self.begin_ns)
        first += (self.begin_ns - first) % PERIOD_NS
        for stamp_ns in range(first, min(end_ns, self.end_ns + 1), PERIOD_NS):
            yield report_at(stamp_ns)

    def frames(self, bus: str, begin_ns: int, end_ns: int) -> list[Frame]:
        lift = load("crane").message("EncLift")
        return [Frame(r.stamp_ns, lift.key, bytes(lift.length)) for r in self.reports(begin_ns, end_ns)]

    def timing(self, at_ns: int) -> dict[str, Any] | None:
        return None
