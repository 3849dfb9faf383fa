"""The soak test: the controller runs at its rate for half an hour; nothing may grow and no frame may be lost."""

from __future__ import annotations

import os
import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from can_dbc.timing.page import Facts
from experiments.common import host_activity
from experiments.common.registry import Options
from experiments.common.result import Metric, Result, make_result
from experiments.common.result_page import Page, Section, publish
from experiments.timing.events import event_metrics, losses_between
from experiments.timing.metrics import MIN_STEADY_TICKS, block_growth, spread_us
from experiments.timing.plots import draw_exceeded
from experiments.timing.testbed import Span, TestbedConfig, TimingTestbed
from machine.loading.profile_file import load_profile
from runtime.plot_style import OIL, TIMBER, sheet

MINUTES: Final = 30.0
QUICK_MINUTES: Final = 1.0 / 3.0
WARM_S: Final = 5.0
READING_PERIOD_S: Final = 5.0
MIN_READINGS: Final = 20
"""Minimum number of readings; a short run reads more often."""
MIN_ACTIVE_SHARE: Final = 0.5
FLAT_KB: Final = 64.0
"""Tolerance for resident memory: it is counted in pages, some of them shared."""
JITTER_BLOCKS: Final = 8.0
"""Blocks that come and go between readings; a leak of one block per second exceeds this even in a short run."""
STOP_BLOCKS: Final = 40.0
"""Blocks that may remain after a stop and the following arming (25 measured; a second stop adds none)."""

_BLOCKS: Final = "sys.getallocatedblocks, from the timing page."
_ACTIVE: Final = "Mode ACTIVE; a host that stalls one of the processes stops the machine, as intended."
MEMORY: Final = Section(
    "Memory",
    "Read every few seconds. Growth is the maximum of the second half of the run less the maximum of the first half. "
    "The interpreter's memory blocks come and go, so their minima are compared.",
    (
        Metric("controller_growth_kb", "Growth of the controller's resident memory", "kB", "VmRSS.", most=FLAT_KB),
        Metric("guard_growth_kb", "Growth of the guard's resident memory", "kB", "VmRSS.", most=FLAT_KB),
        Metric("allocated_blocks_growth", "Growth of allocated memory blocks in the controller", "", _BLOCKS, most=0.0),
        Metric("gc_runs", "Runs of the garbage collector in the controller", "", most=0.0),
        Metric("major_faults", "Major page faults in the controller", "", most=0.0),
    ),
    (("memory.png", "Resident memory of controller and guard, and memory blocks of the controller, over the run."),),
)
FRAMES: Final = Section(
    "Frames",
    "A bus observer reads the controller's record of every tick: all frames that it received and sent, in order. "
    "Protected frames carry a counter and a CRC; a counter that is not consecutive is a lost frame. Encoder frames "
    "carry none, but every SYNC must be answered. The emulated machine checks its received frames in the same way.",
    (
        Metric("minutes", "Duration", "min", "After a few seconds of warm-up."),
        Metric("received", "Frames received by the controller", ""),
        Metric("sent", "Frames sent by the controller", ""),
        Metric("gaps", "Gaps in its protected frames, received and sent", "", most=0.0),
        Metric("gaps_rig", "Gaps in the frames received by the emulated machine", "", most=0.0),
        Metric("damaged", "Frames with a wrong CRC", "", "By both.", most=0.0),
        Metric("unanswered", "SYNCs not answered by an encoder", "", most=0.0),
        Metric("frames_lost", "Frames refused by a bus or lost before they were read", "", "By both.", most=0.0),
        Metric("records_lost", "Missing tick records", "", "By their nominal times.", most=0.0),
    ),
)
TIMES: Final = Section(
    "Timing",
    "The histogram of the whole run. In user-mode Linux a system call costs a hundred times as much as on the host, so "
    "these numbers show that the machine works there, not what the controller costs.",
    (
        Metric("ticks", "Ticks", ""),
        Metric("missed", "Missed periods", "", "Whole periods skipped."),
        Metric("stops", "Stops of the machine", "", "The emulated operator arms it again after each."),
        Metric("stops_unexplained", "Stops without a stall of the host", "", "By the witness of the testbed."),
        Metric(
            "active_share", "Share of the readings in which the machine moved", "%", _ACTIVE, least=MIN_ACTIVE_SHARE
        ),
        Metric("wakeup_p50_us", "Lateness, median", "us"),
        Metric("wakeup_p99_us", "Lateness, p99", "us"),
        Metric("wakeup_max_us", "Lateness, longest", "us"),
        Metric("tick_cpu_p99_us", "CPU time of a tick, p99", "us"),
        Metric("steal_ms", "Time taken by the hypervisor", "ms", "/proc/stat."),
    ),
    (("lateness.png", "Share of wake-ups later than x."),),
)
SECTIONS: Final = (FRAMES, MEMORY, TIMES)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)
CONCLUSION: Final = (
    "In {minutes} the controller received {received} frames and sent {sent}; {records_lost} tick records are missing, "
    "and its resident memory grew by {controller_growth_kb}.",
)
INTRODUCTION: Final = (
    "The real controller and guard run on the timing testbed without a pause. Nothing may grow, and no frame may be "
    "lost."
)


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: seconds since the start, the controller's counters, resident memory of both [kB], mode."""

    at_s: float
    facts: Facts
    controller_kb: int
    guard_kb: int
    mode: str


def run(options: Options, console: Console) -> Result:
    """Run the soak test; write ``options.out`` and, if requested, the docs."""
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    profile = load_profile(options.profile)
    setting = TestbedConfig(options.profile, profile.rate_hz, options.bus)
    console.print(f"soak: {minutes:.3g} minutes, {profile.name} at {profile.rate_hz} Hz on {options.bus}")
    first_sample = host_activity.sample()
    with console.status("soak: starting") as status, TimingTestbed(setting, options.out / "testbed") as testbed:
        testbed.wait(WARM_S)
        mark, before = testbed.mark(), testbed.counters()
        began, readings = time.monotonic(), list[Reading]()
        while (passed := time.monotonic() - began) < 60.0 * minutes:
            readings.append(read(testbed, passed))
            status.update(f"soak: {passed / 60:.1f} of {minutes:.3g} min, {readings[-1].facts.words}")
            testbed.wait(min(READING_PERIOD_S, 60.0 * minutes / MIN_READINGS, 60.0 * minutes - passed))
        span = testbed.since(mark)
        readings.append(read(testbed, time.monotonic() - began))
        counted = testbed.counters()
        counted.subtract(before)
    of_events = event_metrics([testbed.events])
    metrics = {
        "minutes": minutes,
        "ticks": float(span.ticks),
        "missed": float(span.missed),
        **{name: of_events[name] for name in ("stops", "stops_unexplained", "stalls", "stall_max_ms")},
        "active_share": sum(r.mode == "ACTIVE" for r in readings) / len(readings),
        "steal_ms": host_activity.between(first_sample, host_activity.sample()).steal_ms,
        **memory(readings),
        **frames(counted, span),
        **spread_us("wakeup", span.durations["wake"]),
        **spread_us("tick_cpu", span.durations["cpu"]),
    }
    result = make_result(
        "soak",
        METRICS,
        metrics,
        profile=profile.name,
        seed=options.seed,
        trials=1,
        more={
            **host_activity.describe(),
            "bus": options.bus,
            "rate_hz": str(profile.rate_hz),
            "lab": " in user-mode Linux" if os.environ.get("TIMBERHAND_LAB") == "uml" else "",
            "events": "; ".join(testbed.events.sentences()),
            "tick": readings[-1].facts.tick,
        },
        undecided=undecided(metrics),
    )
    options.out.mkdir(parents=True, exist_ok=True)
    draw_memory(readings, options.out / "memory.png")
    with sheet(options.out / "lateness.png") as axis:
        draw_exceeded(axis, {"controller": span.durations["wake"]}, setting.period_ns)
    publish(result, page_of(result, {}), options, console)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    e = result.environment
    rate = f" at {e['rate_hz']} Hz" if "rate_hz" in e else ""
    where = f"`{result.profile}`{rate} on {e['bus']}{e['lab']}"
    setting = f"Commit `{result.commit}`, {where}. {host_activity.sentence(e)}"
    return Page("Soak test", CONCLUSION, INTRODUCTION, SECTIONS, setting, "make soak")


def undecided(metrics: Mapping[str, float]) -> dict[str, str]:
    """List the metrics that this run cannot decide, with the reason; stops are the host's if a witness saw it stall."""
    reasons = {}
    if metrics["active_share"] < MIN_ACTIVE_SHARE and metrics["stops"] and not metrics["stops_unexplained"]:
        reasons["active_share"] = f"the host withheld a processor for up to {metrics['stall_max_ms']:.0f} ms"
    most = STOP_BLOCKS if metrics["stops"] else JITTER_BLOCKS
    if metrics["ticks"] < MIN_STEADY_TICKS and 0.0 < metrics["allocated_blocks_growth"] <= most:
        reasons["allocated_blocks_growth"] = f"{metrics['ticks']:.0f} ticks are too few to detect a leak"
    return reasons


def read(testbed: TimingTestbed, at_s: float) -> Reading:
    """Read a running testbed."""
    status = (Path(f"/proc/{testbed.family.children[n].process.pid}/status") for n in ("controller", "guard"))
    resident = (re.search(r"^VmRSS:\s+(\d+)", path.read_text(), re.MULTILINE) for path in status)
    controller, guard = (int(match[1]) if match else 0 for match in resident)
    return Reading(at_s, testbed.timing().facts, controller, guard, testbed.mode)


def memory(readings: Sequence[Reading]) -> dict[str, float]:
    """Compute the growth between the halves of a run, and counters of the controller's process."""
    half = max(1, len(readings) // 2)
    first, last = readings[0].facts.process, readings[-1].facts.process

    def growth(name: str) -> float:
        sizes_kb: list[int] = [getattr(reading, name) for reading in readings]
        return float(max(sizes_kb[half:]) - max(sizes_kb[:half]))

    return {
        "controller_growth_kb": growth("controller_kb"),
        "guard_growth_kb": growth("guard_kb"),
        "allocated_blocks_growth": block_growth([r.facts for r in readings]),
        "gc_runs": float(last.gc_runs - first.gc_runs),
        "major_faults": float(last.major_faults - first.major_faults),
    }


def frames(counted: Counter[str], span: Span) -> dict[str, float]:
    """Count the frames in a run, by bus observer, emulated machine and controller."""
    lost = sum(loss.frames for loss in losses_between(span.begin, span.end))
    names = ("received", "sent", "gaps", "gaps_rig", "damaged", "unanswered", "records_lost")
    counts = {name: float(counted[name]) for name in names}
    return counts | {"frames_lost": float(lost + counted["machine_frames_lost"])}


def draw_memory(readings: Sequence[Reading], path: Path) -> None:
    """Plot the growth since the first reading."""
    with sheet(path, 2) as axes:
        for axis, label, colour, values in (
            (axes[0], "controller", OIL, [r.controller_kb for r in readings]),
            (axes[0], "guard", TIMBER, [r.guard_kb for r in readings]),
            (axes[1], None, OIL, [r.facts.process.allocated_blocks for r in readings]),
        ):
            axis.plot([r.at_s / 60 for r in readings], [v - values[0] for v in values], color=colour, label=label)
        axes[0].set_ylabel("resident memory since the start [kB]")
        axes[0].legend()
        axes[1].set_ylabel("blocks of the controller since the start")
        for axis in axes:
            axis.set_xlabel("min")
