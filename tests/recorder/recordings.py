"""A small synthetic recording, the same at every call."""

from __future__ import annotations

from pathlib import Path

from can_dbc.dbc.codec import load
from can_dbc.frame import EXTENDED, REMOTE, Frame
from can_dbc.messages import datagrams, tick_record
from can_dbc.messages.crane import StateReport
from machine.loading.profile_file import load_profile
from recorder.manifest import Manifest, describe
from recorder.recorder import Recorder

PROFILE = load_profile("palms_471")
CRANE = load("crane")
T_NS = 5_000_000
START_NS = 7_000_000_123


def manifest(**options) -> Manifest:
    return describe(PROFILE, ("crane0",), seed=3, **options)


def frames(k: int) -> list[Frame]:
    """The bus traffic of tick ``k``: an encoder, a foreign frame, a remote frame, and a SYNC."""
    at = START_NS + k * T_NS
    encoder = CRANE.message("EncSlew")
    position = encoder.encode(*(1000 + k if s.name == "Position" else k % 100 for s in encoder.signals))
    return [
        Frame(at, encoder.key, position),
        Frame(at + 1000, 0x18FF1234 | EXTENDED, bytes([k & 255, 2])),
        Frame(at + 2000, 0x123 | REMOTE, b""),
        Frame(at + 3000, CRANE.message("Sync").key, bytes([k % 240])),
    ]


def tick(k: int) -> bytes:
    now_ns = START_NS + k * T_NS
    quiet, out = tick_record.BusReading(), [(0x210, bytes(8))]
    return tick_record.encode(tick_record.TickRecord(now_ns, 0, 0, 0, quiet, quiet, frames(k), (), (), out, (), b""))


def report(k: int) -> bytes:
    nan = (float("nan"),) * 5
    return datagrams.encode(
        StateReport(k, 1, START_NS + k * T_NS, 3, 0, 0, 0, 0, 0, 0, nan, nan, nan, 50.0, 1.0, 2.0, 3, 4, 5, k)
    )


def feed(recorder: Recorder, ticks: range) -> None:
    for k in ticks:
        for frame in frames(k):
            recorder.on_frame("crane0", frame)
        recorder.on_tick(tick(k))
        if k % 4 == 0:
            recorder.on_report(report(k))


def record(directory: Path, ticks: int = 200, **options) -> Recorder:
    recorder = Recorder(directory, PROFILE, manifest(**options))
    feed(recorder, range(ticks))
    recorder.close()
    return recorder
