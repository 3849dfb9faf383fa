"""What was lost or stopped during a measurement, and whether the host had withheld a processor before; pure.

A loss is the growth of a counter of the controller between two of its timing pages; a stop is a change of mode to STOP
or FAULT.  Both are explained by a stall that a witness saw (`experiments.common.stall_witness`) shortly before: within
the slowest detection of a fault, and for a loss within the second between two pages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from can_dbc.timing.page import Facts
from controller.config import TX_QUEUE_NS
from machine.status.reasons import Reason

STALL_NS: Final = 10_000_000
"""A stall of two periods at 200 Hz is long enough to lose a tick, and with it to stop a machine."""
REACH_NS: Final = 300_000_000
"""The slowest detection of a fault (a lease of 200 ms), with the period of setpoints and reports."""
LOSING_STALL_NS: Final = 25_000_000
"""A stall of this length loses frames at any rate, a shorter one if the transmit queue overflows in it."""

OWN_SHARE: Final = 0.85
"""Load by real-time processes near which Linux withholds the processor from them: 50 ms of every second at 95 %
(sched_rt_runtime_us, and the fair server of newer kernels).  Such a stall is ours and explains nothing away."""


@dataclass(frozen=True, slots=True)
class Stall:
    """A processor stood still for ``length_ns`` until ``end_ns`` (CLOCK_MONOTONIC)."""

    cpu: int
    end_ns: int
    length_ns: int
    own_share: float = 0.0
    """Load of the testbed's own real-time processes on that processor at the time."""


@dataclass(frozen=True, slots=True)
class Event:
    """A stop (with its reason) or lost frames, between two times; a stall of ``least_ns`` can have caused it."""

    text: str
    from_ns: int
    to_ns: int
    least_ns: int
    frames: int = 0
    reason: str = ""


def stop(at_ns: int, reason: Reason, words: str) -> Event:
    """Tell that the controller left ARMED or ACTIVE by itself."""
    return Event(f"stop, {reason.name}: {words}", at_ns, at_ns, STALL_NS, reason=reason.name)


def loss(from_ns: int, to_ns: int, bus: str, refused: int, dropped: int) -> Event:
    """Tell frames lost on a bus: refused ones need a stall that fills the transmit queue, others a longer one."""
    text = f"{bus}: {refused} frames refused, {dropped} dropped"
    return Event(text, from_ns, to_ns, TX_QUEUE_NS if refused else LOSING_STALL_NS, refused + dropped)


@dataclass(frozen=True, slots=True)
class Events:
    """Everything that was lost, stopped or stalled in one measurement."""

    stops: list[Event] = field(default_factory=list)
    losses: list[Event] = field(default_factory=list)
    stalls: list[Stall] = field(default_factory=list)

    def cause(self, event: Event) -> Stall | None:
        """Find the longest stall of the host that can have caused a stop or a loss."""
        fitting = [
            s
            for s in self.stalls
            if s.own_share < OWN_SHARE
            and s.length_ns >= event.least_ns
            and s.end_ns >= event.from_ns - REACH_NS
            and s.end_ns - s.length_ns <= event.to_ns + STALL_NS
        ]
        return max(fitting, key=lambda stall: stall.length_ns, default=None)

    def sentences(self, where: str = "") -> list[str]:
        """Write one sentence for every stop and loss: where, what, and the stall of the host before it."""
        events = sorted([*self.stops, *self.losses], key=lambda event: event.to_ns)
        return [f"{where}{': ' if where else ''}{event.text} [{_words(self.cause(event))}]" for event in events]


def _words(stall: Stall | None) -> str:
    return "not explained" if stall is None else f"processor {stall.cpu} stood still for {stall.length_ns / 1e6:.0f} ms"


def losses_between(before: Facts, after: Facts) -> list[Event]:
    """List the losses that the controller's counters show between two pages."""
    counts = [
        (new.name, new.refused - old.refused, new.dropped - old.dropped)
        for old, new in zip(before.buses, after.buses, strict=True)
    ]
    return [loss(before.written_ns, after.written_ns, *count) for count in counts if any(count[1:])]


def event_metrics(measured: Sequence[Events]) -> dict[str, float]:
    """Count stops and losses of several measurements, those that no stall of the host explains, and the stalls."""
    losses = [(x.frames, events.cause(x)) for events in measured for x in events.losses]
    causes = [events.cause(stop) for events in measured for stop in events.stops]
    stalls = [stall for events in measured for stall in events.stalls]
    return {
        "frames_lost": float(sum(frames for frames, _ in losses)),
        "frames_lost_unexplained": float(sum(frames for frames, cause in losses if cause is None)),
        "stops": float(len(causes)),
        "stops_unexplained": float(causes.count(None)),
        "stalls": float(len(stalls)),
        "stall_max_ms": max((s.length_ns for s in stalls), default=0) / 1e6,
    }


def explained(metrics: Mapping[str, float]) -> dict[str, str]:
    """List the losses and stops that the host's stalls explain, all of them: inconclusive, with the reason."""
    why = (
        f"the host withheld a processor for up to {metrics['stall_max_ms']:.0f} ms; a witness saw a stall before each "
        "of them"
    )
    return {n: why for n in ("frames_lost", "stops") if metrics[n] and not metrics[f"{n}_unexplained"]}
