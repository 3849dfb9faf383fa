"""Failures of the services: what systemd saw of their end, kept by deploy/system/service-ended.

A controller or guard that dies reports no stop of its own; the valves are neutral, and this is what is left.
"""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from timberhand.service_status import ending

SERVICE_FAILURES: Final = Path("/var/lib/timberhand-failures/failures.jsonl")


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """One failure: ``result``, ``code`` and ``status`` are those of systemd.exec(5), ``utc_s`` the wall clock [s]."""

    unit: str
    result: str
    code: str
    status: str
    utc_s: int
    release: str

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        at = datetime.datetime.fromtimestamp(self.utc_s, datetime.UTC)
        how = ending(self.result, self.status)
        return f"{self.unit} failed at {at:%Y-%m-%d %H:%M:%S} UTC: {how} (release {self.release or 'unknown'})"


def failures(file: Path = SERVICE_FAILURES) -> Iterator[Failure]:
    """The failures in a file, oldest first; none without a file; a line that was cut off is left out."""
    try:
        lines = file.read_bytes().splitlines()
    except OSError:
        return
    for line in lines:
        with contextlib.suppress(msgspec.DecodeError):
            yield msgspec.json.decode(line, type=Failure)


def newest_failure(after_utc_ns: int | None, file: Path = SERVICE_FAILURES) -> tuple[Failure, int] | None:
    """The newest failure that is not older than a stop, and how often that service has failed since; None: none."""
    since = [found for found in failures(file) if after_utc_ns is None or found.utc_s * 10**9 >= after_utc_ns - 10**9]
    if not since:
        return None
    return since[-1], sum(found.unit == since[-1].unit for found in since)
