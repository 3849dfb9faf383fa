"""Judges whether a computer is fit to run the control loop: figures of a short measurement in, verdicts out; pure.

A bad figure that depends on the clock is *inconclusive* when the computer was disturbed meanwhile; a good one stays
good.  The limits are shares of the control period.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

GOOD_LATE_SHARE: Final = 0.1
MARGINAL_LATE_SHARE: Final = 0.5
"""Longest lateness of a wake-up, as a share of the period."""
GOOD_TICK_SHARE: Final = 0.1
MARGINAL_TICK_SHARE: Final = 0.3
"""CPU time of a tick at p99, as a share of the period; the rest is for late frames and the other processes."""
MIN_TICKS: Final = 5_000
"""Fewer ticks than this show too little of the tail for a good verdict."""
STEAL_SHARE: Final = 0.005
"""Share of one processor's time that a hypervisor may take."""
BUSY_SHARE: Final = 0.5
"""Load average per processor before the measurement from which on other programs disturb it."""
SAME_SHARE: Final = 0.5
"""From this share of our lateness on, the reference loop was late for the same reason."""


class Verdict(StrEnum):
    """From best to worst; `overall` takes the worst."""

    GOOD = "good"
    MARGINAL = "marginal"
    INCONCLUSIVE = "inconclusive"
    UNFIT = "unfit"


@dataclass(frozen=True, slots=True)
class Judgement:
    """The verdict on one topic: what was found, and what to do about it (empty when nothing is to be done)."""

    topic: str
    verdict: Verdict
    sentence: str
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Figures:
    """The measured figures; times in us unless the name says otherwise.

    ``reference``: the loop beside the controller that does no work ("cyclictest", or "sleep loop" without it);
    ``fifo``, ``locked_kb``, ``refused``: what the system granted to the controller.  ``load_before``: load average per
    processor before the measurement.
    """

    seconds: float
    period_us: float
    ticks: int
    missed: int
    late_p50_us: float
    late_p99_us: float
    late_max_us: float
    reference: str
    reference_p99_us: float
    reference_max_us: float
    tick_p50_us: float
    tick_p99_us: float
    frames_lost: int
    page_faults: int
    gc_runs: int
    stops: int
    fifo: bool
    locked_kb: int
    refused: tuple[str, ...]
    steal_ms: float
    load_before: float
    emulated: bool


def disturbances(f: Figures) -> list[str]:
    """Why clocked figures cannot be held against this computer; empty when it was left alone."""
    found = []
    if f.emulated:
        found.append("this kernel runs as a process of another one")
    if f.steal_ms > STEAL_SHARE * 1e3 * f.seconds:
        found.append(f"the hypervisor took {f.steal_ms:.0f} ms in {f.seconds:.0f} s")
    if f.load_before > BUSY_SHARE:
        found.append(f"other programs were running (load {f.load_before:.1f} per processor)")
    return found


def judge(f: Figures) -> tuple[Judgement, ...]:
    """The verdicts of all topics."""
    return (rights(f), wakeups(f), tick_cost(f), losses(f), memory(f), stops(f))


def overall(found: Iterable[Judgement]) -> Verdict:
    """The worst verdict."""
    order = list(Verdict)
    return max((j.verdict for j in found), key=order.index, default=Verdict.INCONCLUSIVE)


def rights(f: Figures) -> Judgement:
    """FIFO scheduling and locked memory."""
    if f.fifo and f.locked_kb and not f.refused:
        sentence = f"the controller runs with SCHED_FIFO and {f.locked_kb >> 10} MB of locked memory"
        return Judgement("rights", Verdict.GOOD, sentence)
    refused = "; ".join(f.refused) or "no real-time priority or no locked memory"
    return Judgement(
        "rights", Verdict.UNFIT, f"the system refused: {refused}",
        "run the report with sudo, or give this user the limits of the service (topics priority and memory below)",
    )  # fmt: skip


def wakeups(f: Figures) -> Judgement:
    """Lateness of the wake-ups, and deadlines missed."""
    said = (
        f"{f.missed} of {f.ticks + f.missed} deadlines missed; late by {f.late_p50_us:.0f} us in the median, "
        f"{f.late_p99_us:.0f} at p99, {f.late_max_us:.0f} at most; {f.reference} {f.reference_max_us:.0f} at most"
    )
    if math.isnan(f.late_max_us):
        return Judgement("wake-ups", Verdict.INCONCLUSIVE, "no tick was measured", "measure again")
    if f.missed or f.late_max_us > MARGINAL_LATE_SHARE * f.period_us:
        verdict = Verdict.UNFIT
    else:
        verdict = Verdict.GOOD if f.late_max_us <= GOOD_LATE_SHARE * f.period_us else Verdict.MARGINAL
    if verdict is Verdict.GOOD:
        if f.ticks < MIN_TICKS:
            advice = f"measure longer: a good verdict needs {MIN_TICKS} ticks"
            return Judgement("wake-ups", Verdict.INCONCLUSIVE, said, advice)
        return Judgement("wake-ups", Verdict.GOOD, said)
    if why := disturbances(f):
        advice = "end other programs, or use a computer without a hypervisor, and measure again"
        return Judgement("wake-ups", Verdict.INCONCLUSIVE, f"{said}; {' and '.join(why)}", advice)
    if f.reference_max_us >= SAME_SHARE * f.late_max_us:
        advice = f"{f.reference} was late, too: kernel, firmware or drivers; the settings below, the first one first"
    elif not f.fifo:
        advice = "the controller had no real-time priority; see the topic rights"
    else:
        advice = f"{f.reference} was not late: this is the controller's own; send this report"
    return Judgement("wake-ups", verdict, said, advice)


def tick_cost(f: Figures) -> Judgement:
    """CPU time of a tick; other programs raise it, because they use the caches."""
    said = f"a tick takes {f.tick_p50_us:.0f} us of CPU time in the median, {f.tick_p99_us:.0f} at p99"
    share = f.tick_p99_us / f.period_us
    if math.isnan(share):
        return Judgement("tick", Verdict.INCONCLUSIVE, "no tick was measured", "measure again")
    if share <= GOOD_TICK_SHARE:
        return Judgement("tick", Verdict.GOOD, said)
    if why := disturbances(f):
        return Judgement("tick", Verdict.INCONCLUSIVE, f"{said}; {' and '.join(why)}", "measure again, undisturbed")
    advice = "compile the tick (timberhand compile), set the governor to performance, or use a faster processor"
    verdict = Verdict.MARGINAL if share <= MARGINAL_TICK_SHARE else Verdict.UNFIT
    return Judgement("tick", verdict, said, advice)


def losses(f: Figures) -> Judgement:
    """Frames refused by a bus or lost before they were read."""
    said = f"{f.frames_lost} frames were lost"
    if not f.frames_lost:
        return Judgement("frames", Verdict.GOOD, said)
    if why := disturbances(f):
        return Judgement("frames", Verdict.INCONCLUSIVE, f"{said}; {' and '.join(why)}", "measure again, undisturbed")
    advice = "the controller read too late: first correct wake-ups and rights; else send this report"
    return Judgement("frames", Verdict.UNFIT, said, advice)


def memory(f: Figures) -> Judgement:
    """Page faults and garbage collections while it ran."""
    said = f"{f.page_faults} page faults, {f.gc_runs} runs of the garbage collector"
    if not f.page_faults and not f.gc_runs:
        return Judgement("memory", Verdict.GOOD, said)
    if f.page_faults and not f.locked_kb:
        return Judgement("memory", Verdict.MARGINAL, said, "memory is not locked; see the topic rights")
    return Judgement("memory", Verdict.MARGINAL, said, "memory was locked, so this should be 0: send this report")


def stops(f: Figures) -> Judgement:
    """Stops of the machine by its supervisor."""
    said = f"the supervisor stopped the machine {f.stops} times"
    if not f.stops:
        return Judgement("stops", Verdict.GOOD, said)
    if why := disturbances(f):
        return Judgement("stops", Verdict.INCONCLUSIVE, f"{said}; {' and '.join(why)}", "measure again, undisturbed")
    return Judgement("stops", Verdict.UNFIT, said, "the reasons are under 'stop_reasons'; correct wake-ups first")
