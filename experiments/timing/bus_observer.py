"""Checks the controller's tick records for missing data: ``python -m experiments.timing.bus_observer``.

Input: the ring of tick records (`can_dbc.messages.record_ring`), polled.  It checks the frames that the controller
received and sent (`experiments.timing.continuity`), and that no record is missing apart from missed periods.  It prints
its totals once a second as a JSON line.  Exit codes: 0 stopped by SIGTERM or SIGINT, 2 usage, 3 profile.
"""

from __future__ import annotations

import argparse
import gc
import json
import signal
import sys
import time
from pathlib import Path
from typing import Final

from can_dbc.messages.record_ring import RingReader
from can_dbc.messages.tick_record import RecordRefused, TickRecord, decode
from can_dbc.protocols.canopen import SYNC_ID
from experiments.timing.continuity import Continuity, databases
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import Profile

PRINT_PERIOD_NS: Final = 1_000_000_000
POLL_PERIOD_S: Final = 0.05
"""A fortieth of what the ring holds at 1 kHz."""


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
        except RecordRefused:
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
        """SYNCs without an answer of at least one encoder since all encoders run; one answer may be in flight."""
        if not self._first:
            return 0
        syncs = self.sent.frames[SYNC_ID] - self._first[SYNC_ID]
        answers = min(self.received.frames[key] - self._first[key] for key in self._encoders)
        return max(0, syncs - answers - 1)

    def totals(self) -> dict[str, int]:
        """All counters."""
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
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.timing.bus_observer", description="Check the tick records of a controller."
    )
    parser.add_argument("--profile", required=True)
    parser.add_argument("--rate", required=True, type=int, metavar="HZ")
    parser.add_argument("--ticks", required=True, type=Path, help="ring of the tick records")
    options = parser.parse_args(arguments)
    try:
        observer = BusObserver(load_profile(options.profile), 1_000_000_000 // options.rate)
    except ProfileError as error:
        sys.stderr.write(f"bus observer: {error}\n")
        return 3
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    ring = RingReader(options.ticks)
    gc.collect()
    gc.freeze()
    print("ready", flush=True)
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
