"""Checks the controller's tick records for missing data: ``python -m experiments.timing.bus_observer``.

Input: the ring of tick records (`can_dbc.messages.record_ring`), polled.  It checks the frames that the controller
received and sent, and that no record is missing apart from missed periods.  It prints its totals once a second as a
JSON line until SIGTERM or SIGINT.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from can_dbc.dbc.codec import Database, load
from can_dbc.messages.record_ring import RingReader
from can_dbc.messages.tick_record import TickRecord, decode
from can_dbc.protocols.canopen import SYNC_ID
from can_dbc.protocols.e2e import Checker, Status
from hil.harness.processes import announce_ready
from machine.loading.profile_file import load_profile
from machine.profile import Profile
from runtime.errors import InputRefused

PRINT_PERIOD_NS: Final = 1_000_000_000
POLL_PERIOD_S: Final = 0.05
"""A fortieth of what the ring holds at 1 kHz."""


class Continuity:
    """Frames that one participant saw on a bus.

    ``frames`` counts them by key; ``gaps`` and ``damaged`` count protected frames with a counter that is not
    consecutive, or with a wrong CRC.
    """

    def __init__(self, databases: Iterable[Database]) -> None:
        every = [m for database in databases for m in database.messages.values()]
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


def databases(profile: Profile) -> list[Database]:
    """Load the databases that define the protected frames of a machine."""
    return [load("crane"), *([load("machine")] if profile.machine_bus else [])]


class BusObserver:
    """Tick records in, totals out; pure."""

    def __init__(self, profile: Profile, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last: TickRecord | None = None
        known = databases(profile)
        self.received, self.sent = Continuity(known), Continuity(known)
        specs = [s.encoder for s in profile.joints.values() if s.encoder]
        specs += [profile.carrier.articulation_encoder] if profile.carrier else []
        self._encoders = [known[0].message(spec.message).key for spec in specs]
        self._first: dict[int, int] = {}
        self.records = self.lost = self.unreadable = 0

    def add(self, data: bytes) -> None:
        """Add one record."""
        try:
            record = decode(data)
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


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.timing.bus_observer", description="Check the tick records of a controller."
    )
    parser.add_argument("--profile", required=True)
    parser.add_argument("--rate", required=True, type=int, metavar="HZ")
    parser.add_argument("--ticks", required=True, type=Path, help="ring of the tick records")
    options = parser.parse_args(arguments)
    observer = BusObserver(load_profile(options.profile), 1_000_000_000 // options.rate)
    ring = RingReader(options.ticks)
    ended = announce_ready()
    next_print_ns = 0
    while not ended:
        time.sleep(POLL_PERIOD_S)
        for record in ring.read():
            observer.add(record)
        now_ns = time.monotonic_ns()
        if now_ns >= next_print_ns:
            next_print_ns = now_ns + PRINT_PERIOD_NS
            print(json.dumps(observer.totals()), flush=True)
    print(json.dumps(observer.totals()), flush=True)
    ring.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
