"""What was lost or stopped during a measurement, and whether the host had withheld a processor before; pure.

A loss is the growth of a counter of the controller between two of its timing pages; a stop is a change of mode to STOP
or FAULT.  Both are explained by a stall that a witness saw (`experiments.timing.stall_witness`) shortly before: within
the slowest detection of a fault, and for a loss within the second between two pages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from can_dbc.timing.page import Facts
from controller.process.tx_queue import TX_QUEUE_NS
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

    @property
    def by_the_host(self) -> bool:
        """Whether it was not the testbed itself that filled the processor."""
        return self.own_share < OWN_SHARE


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
    def least_stall_ns(self) -> int:
        """The shortest stall that loses frames: refused ones until the transmit queue is full, at any rate."""
        return TX_QUEUE_NS if self.refused else LOSING_STALL_NS

    @property
    def frames(self) -> int:
        """Frames lost in either direction."""
        return self.refused + self.dropped


def losses_between(before: Facts, after: Facts) -> list[Loss]:
    """What the controller's counters say of the time between two pages."""
    found = []
    for old, new in zip(before.buses, after.buses, strict=True):
        refused, dropped = new.refused - old.refused, new.dropped - old.dropped
        if refused or dropped:
            found.append(Loss(before.written_ns, after.written_ns, new.name, refused, dropped))
    return found


def stall_before_stop(stop: Stop, stalls: Sequence[Stall]) -> Stall | None:
    """The longest stall of the host that can have caused a stop."""
    return _longest(stalls, stop.at_ns - REACH_NS, stop.at_ns + STALL_NS, STALL_NS)


def stall_of_loss(loss: Loss, stalls: Sequence[Stall]) -> Stall | None:
    """The longest stall of the host that can have caused a loss."""
    return _longest(stalls, loss.from_ns - REACH_NS, loss.to_ns + STALL_NS, loss.least_stall_ns)


def _longest(stalls: Sequence[Stall], from_ns: int, to_ns: int, least_ns: int) -> Stall | None:
    fitting = [
        s
        for s in stalls
        if s.by_the_host and from_ns <= s.end_ns and s.end_ns - s.length_ns <= to_ns and s.length_ns >= least_ns
    ]
    return max(fitting, key=lambda stall: stall.length_ns, default=None)


def sentences(stops: Sequence[Stop], losses: Sequence[Loss], stalls: Sequence[Stall]) -> list[str]:
    """One sentence for every stop and loss: what, and the stall of the host before it."""
    found = [(s.at_ns, f"stop, {s.reason.name}: {s.words}", stall_before_stop(s, stalls)) for s in stops]
    found += [
        (x.to_ns, f"{x.bus}: {x.refused} frames refused, {x.dropped} dropped", stall_of_loss(x, stalls)) for x in losses
    ]
    return [f"{what} [{_cause(stall)}]" for _, what, stall in sorted(found, key=lambda item: item[0])]


def _cause(stall: Stall | None) -> str:
    return "not explained" if stall is None else f"processor {stall.cpu} stood still for {stall.length_ns / 1e6:.0f} ms"
