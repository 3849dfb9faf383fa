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
class Stop:
    """The controller left ARMED or ACTIVE by itself at ``at_ns``."""

    at_ns: int
    reason: Reason
    words: str


@dataclass(frozen=True, slots=True)
class Loss:
    """Frames that the controller counted as lost on a bus between two pages."""

    from_ns: int
    to_ns: int
    bus: str
    refused: int
    dropped: int

    @property
    def frames(self) -> int:
        """Frames lost in either direction."""
        return self.refused + self.dropped


@dataclass(frozen=True, slots=True)
class Events:
    """Everything that was lost, stopped or stalled in one measurement."""

    stops: list[Stop] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    stalls: list[Stall] = field(default_factory=list)

    def cause(self, event: Stop | Loss) -> Stall | None:
        """Find the longest stall of the host that can have caused a stop or a loss.

        Refused frames need a stall that fills the transmit queue, other losses one that loses frames at any rate.
        """
        if isinstance(event, Stop):
            from_ns, to_ns, least_ns = event.at_ns, event.at_ns, STALL_NS
        else:
            from_ns, to_ns = event.from_ns, event.to_ns
            least_ns = TX_QUEUE_NS if event.refused else LOSING_STALL_NS
        fitting = [
            s
            for s in self.stalls
            if s.own_share < OWN_SHARE
            and s.length_ns >= least_ns
            and s.end_ns >= from_ns - REACH_NS
            and s.end_ns - s.length_ns <= to_ns + STALL_NS
        ]
        return max(fitting, key=lambda stall: stall.length_ns, default=None)

    def sentences(self) -> list[str]:
        """Write one sentence for every stop and loss: what, and the stall of the host before it."""
        events: list[tuple[int, str, Stop | Loss]] = [
            (s.at_ns, f"stop, {s.reason.name}: {s.words}", s) for s in self.stops
        ]
        events += [(x.to_ns, f"{x.bus}: {x.refused} frames refused, {x.dropped} dropped", x) for x in self.losses]
        return [f"{text} [{_words(self.cause(event))}]" for _, text, event in sorted(events, key=lambda item: item[0])]


def _words(stall: Stall | None) -> str:
    return "not explained" if stall is None else f"processor {stall.cpu} stood still for {stall.length_ns / 1e6:.0f} ms"


def losses_between(before: Facts, after: Facts) -> list[Loss]:
    """List the losses that the controller's counters show between two pages."""
    losses = []
    for old, new in zip(before.buses, after.buses, strict=True):
        refused, dropped = new.refused - old.refused, new.dropped - old.dropped
        if refused or dropped:
            losses.append(Loss(before.written_ns, after.written_ns, new.name, refused, dropped))
    return losses


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
