"""The rates experiment: the whole forwarder at 1 kHz, cost against frames and joints, cranes on one processor.

The controller runs on the timing testbed at several rates, with the limits and gains of its profile.  How many
controllers one processor carries at 200 Hz is measured with recorded inputs (`experiments.timing.replayed_crane`),
because no computer of this size could emulate as many machines beside them.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from experiments.common import host_activity
from experiments.common.registry import Options
from experiments.common.result import Metric, Result, make_result
from experiments.common.result_page import Page, Section, publish
from experiments.timing.events import STALL_NS, Events, event_metrics, explained
from experiments.timing.metrics import spread_us, unmeasured
from experiments.timing.testbed import TestbedConfig, TimingTestbed, cores
from hil.harness.processes import ProcessGroup
from hil.replay.recording import files_of, manifest_of
from hil.tick.compare import kept_recordings
from host.exit_codes import CommandFailed, ExitCode
from machine.joints import JOINTS
from machine.loading.profile_file import load_profile
from runtime.plot_style import MOSS, OIL, RUST, STEEL, sheet

MACHINES: Final = {"palms_471": "Fixed crane", "aoro_fc8": "Forwarder"}
FORWARDER: Final = "aoro_fc8"
RATES_HZ: Final = (100, 200, 500, 1000)
BITRATES: Final = (("crane0", 4_000_000), ("mach0", 250_000))
"""A CAN bus of 1 Mbit/s carries the traffic of crane0 up to 400 Hz; at 1 kHz the wire stands in for a faster one."""
CARRIER_FUNCTIONS: Final = 8
"""Articulation, drive and six swing arms."""
CRANE_COUNTS: Final = (1, 2, 3, 4, 6, 8, 10, 12, 16)
TRIES: Final = 3
"""A number of controllers fails only if it fails this often: a stall of the host looks the same as too many."""
MISSED_SHARE: Final = 0.001
"""Share of the periods that may be missed before a processor carries too many controllers."""
REPLAY_TICKS: Final = 1000
PERIOD_NS: Final = 5_000_000
REPLAY: Final = "experiments.timing.replayed_crane"
LINES: Final = (*((f"{machine}_frame", title) for machine, title in MACHINES.items()), ("function", "Functions"))
LOAD: Final = ("frames_per_s", "cpu_share")
MAX_RESIDUAL: Final = 0.1
"""Of a straight line, as a share of its largest value."""


@dataclass(frozen=True, slots=True)
class RatePoint:
    """One machine at one rate: what its controller cost (metrics by name), and what was lost or stopped."""

    machine: str
    rate_hz: int
    figures: dict[str, float]
    events: Events = field(default_factory=Events)
    tick: str = ""


@dataclass(frozen=True, slots=True)
class CranePoint:
    """Controllers of one machine on one processor: periods run and missed, cost of all per period [us]."""

    machine: str
    cranes: int
    ticks: int
    missed: int
    differing: int
    cpu_us: float

    @property
    def carried(self) -> bool:
        """Whether the processor kept every deadline but a few."""
        return self.missed <= MISSED_SHARE * self.ticks

    @property
    def functions(self) -> int:
        """Functions that all of them move."""
        return self.cranes * functions_of(self.machine)


def functions_of(machine: str) -> int:
    """Count the functions of a machine: joints, grapple, and on a carrier articulation, drive and swing arms."""
    return len(JOINTS) + 1 + (CARRIER_FUNCTIONS if load_profile(machine).carrier else 0)


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs."""
    seconds, rates, ticks = (3.0, (200, 1000), 400) if options.quick else (10.0, RATES_HZ, REPLAY_TICKS)
    options.out.mkdir(parents=True, exist_ok=True)
    points = []
    with console.status("rates: starting") as status:
        for machine in MACHINES:
            for rate_hz in rates:
                status.update(f"rates: {machine} at {rate_hz} Hz")
                points.append(measure_rate(machine, rate_hz, seconds, options.out / f"{machine}-{rate_hz}"))
        status.update("rates: controllers on one processor")
        cranes = measure_cranes(ticks, options.out / "cranes", CRANE_COUNTS[:2] if options.quick else CRANE_COUNTS)
    metrics = gather(points, cranes)
    result = make_result(
        "rates",
        METRICS,
        metrics,
        profile=FORWARDER,
        seed=options.seed,
        trials=len(points),
        more={
            **host_activity.describe(),
            "tick": points[-1].tick,
            "events": "; ".join(text for p in points for text in p.events.sentences(f"{p.machine} {p.rate_hz} Hz")),
        },
        undecided=undecided(metrics, points),
    )
    draw(points, cranes, options.out / "rates.png")
    publish(result, page_of(result, {}), options, console)
    return result


def measure_rate(machine: str, rate_hz: int, seconds: float, directory: Path) -> RatePoint:
    """Measure one machine at one rate."""
    with TimingTestbed(TestbedConfig(machine, rate_hz, bitrates=BITRATES), directory) as testbed:
        testbed.wait(2.0)
        mark = testbed.mark()
        testbed.wait(seconds)
        span = testbed.since(mark)
        testbed.wait(0.5)
    figures = {**spread_us("cpu", span.durations["cpu"]), **span.load, "ticks": span.ticks, "missed": span.missed}
    return RatePoint(machine, rate_hz, figures, testbed.events, span.end.tick)


def measure_cranes(ticks: int, directory: Path, counts: Sequence[int]) -> list[CranePoint]:
    """Measure ever more controllers of each kept recording on one processor, up to the first that it cannot carry."""
    directory.mkdir(parents=True, exist_ok=True)
    points = []
    with tempfile.TemporaryDirectory() as folder:
        for recording in kept_recordings(Path(folder)):
            for cranes in counts:
                tries: list[CranePoint] = []
                while len(tries) < TRIES and not any(point.carried for point in tries):
                    tries.append(run_cranes(recording, cranes, ticks, directory))
                points.append(min(tries, key=lambda point: point.missed))
                if not points[-1].carried:
                    break
    return points


def run_cranes(recording: Path, cranes: int, ticks: int, directory: Path) -> CranePoint:
    """Run so many controllers on the testbed's last processor, their ticks spread over the period."""
    cpu, _ = cores()
    family, outputs = ProcessGroup(directory), dict[str, dict[str, Any]]()
    start_ns = time.monotonic_ns() + round((3.0 + 2.0 * cranes) * 1e9)
    try:
        for k in range(cranes):
            at_ns = start_ns + k * PERIOD_NS // cranes
            family.start(f"crane-{k}", REPLAY, recording, ticks=ticks, cpu=cpu, start_at=at_ns)
        limit = time.monotonic() + 60.0 + 3.0 * cranes + 3.0 * ticks * PERIOD_NS * 1e-9
        while len(outputs) < cranes:
            for name, message in family.messages():
                if "cpu_us" in message:
                    outputs[name] = message
            dead = family.dead()
            if time.monotonic() > limit or (dead is not None and dead.process.returncode):
                why = "the time is up" if dead is None else dead.complaint()
                raise CommandFailed("rates.replay-failed", f"{cranes} controllers: {why}", ExitCode.CONFIGURATION)
            time.sleep(0.05)
    finally:
        family.stop_all(())
    totals = (sum(x[name] for x in outputs.values()) for name in ("ticks", "missed", "differing", "cpu_us"))
    return CranePoint(Path(manifest_of(files_of(recording)).profile).stem, cranes, *totals)


def fit(x: Sequence[float], y: Sequence[float]) -> tuple[float, float, float]:
    """Compute slope and intercept of the straight line, and its largest residual as a share of the largest value."""
    if len(x) < 2:
        return math.nan, math.nan, math.nan
    slope, intercept = np.polyfit(x, y, 1)
    residual = np.abs(np.array(y) - (slope * np.array(x) + intercept)).max()
    return float(slope), float(intercept), float(residual / max(y))


def loads(points: Sequence[RatePoint], machine: str) -> tuple[list[float], list[float]]:
    """List frames per second and load of a machine at every rate."""
    frames_per_s, shares = ([p.figures[name] for p in points if p.machine == machine] for name in LOAD)
    return frames_per_s, shares


def gather(points: Sequence[RatePoint], cranes: Sequence[CranePoint]) -> dict[str, float]:
    """Compute all metrics."""
    fast = max((p for p in points if p.machine == FORWARDER), key=lambda p: p.rate_hz)
    metrics = {
        **{f"forwarder1k_{name}": value for name, value in fast.figures.items()},
        **event_metrics([p.events for p in points]),
        "differing_ticks": float(sum(c.differing for c in cranes)),
    }
    for machine in MACHINES:
        by_rate = {p.rate_hz: p.figures for p in points if p.machine == machine}
        slope, intercept, residual = fit(*loads(points, machine))
        metrics |= {f"{machine}_frame_us": slope * 1e6, f"{machine}_rest_share": intercept}
        metrics[f"{machine}_frame_residual"] = residual
        metrics |= {f"{machine}_{hz}_{name}": f[name] for hz, f in by_rate.items() for name in LOAD}
        carried = [c.cranes for c in cranes if c.machine == machine and c.carried]
        metrics[f"{machine}_cranes"] = float(max(carried, default=0))
        metrics[f"{machine}_cranes_bound"] = (
            math.floor(0.95 / by_rate[200]["cpu_share"]) if 200 in by_rate else math.nan
        )
    slope, _, residual = fit([float(c.functions) for c in cranes], [c.cpu_us for c in cranes])
    return metrics | {"function_us": slope, "function_residual": residual}


def undecided(metrics: Mapping[str, float], points: Sequence[RatePoint]) -> dict[str, str]:
    """List the metrics that this run cannot decide, with the reason."""
    reasons = unmeasured(METRICS, metrics) | explained(metrics)
    stalled = any(s.length_ns >= STALL_NS for p in points for s in p.events.stalls)
    for name, _ in LINES:
        if metrics[f"{name}_residual"] > MAX_RESIDUAL and stalled:
            reasons[f"{name}_residual"] = "the host stalled during the measurement"
    return reasons


FAST: Final = Section(
    "The forwarder at 1 kHz",
    "Crane and carrier on both buses with the limits and gains of the profile, which are per second and not per tick. "
    "The wire carries crane0 at 4 Mbit/s, because the frames of a millisecond do not fit on a CAN bus of 1 Mbit/s.",
    (
        Metric("forwarder1k_frames_per_s", "Frames received and sent, both buses", "1/s", "The controller's counters."),
        Metric("forwarder1k_cpu_p50_us", "CPU time of a tick, median", "us", "The thread's own clock."),
        Metric("forwarder1k_cpu_p99_us", "CPU time of a tick, p99", "us", "The thread's own clock."),
        Metric("forwarder1k_cpu_share", "CPU load of the controller", "%", "getrusage."),
        Metric("forwarder1k_ticks", "Ticks", ""),
        Metric("forwarder1k_missed", "Missed periods", "", "The host's stalls included."),
        Metric("frames_lost", "Frames refused or lost, all machines and rates", "", "Its own counters.", most=0.0),
        Metric("frames_lost_unexplained", "Lost frames without a stall of the host", "", "By the witness.", most=0.0),
        Metric("stops", "Stops, all machines and rates", "", "By the controller's reports.", most=0.0),
        Metric("stops_unexplained", "Stops without a stall of the host", "", "By the witness.", most=0.0),
    ),
    (("rates.png", "CPU load against frames per second, CPU time per period against the functions moved; fitted."),),
)
COST: Final = Section(
    "Cost against frames and joints",
    "Both are straight lines: a frame and a function cost the same whether there are few or many. The load against "
    "frames is measured live at 100 to 1000 Hz, so that its slope contains the ticks that carry the frames. The cost "
    "against functions is that of several controllers at 200 Hz on one processor. A residual is the largest of a line, "
    "as a share of the largest value.",
    (
        *(Metric(f"{machine}_frame_us", f"{title}: CPU time per frame", "us") for machine, title in MACHINES.items()),
        Metric("function_us", "CPU time per function and period", "us", "Slope of the line, both machines."),
        *(Metric(f"{name}_residual", f"{title}: largest residual", "%", most=MAX_RESIDUAL) for name, title in LINES),
    ),
)
CRANES: Final = Section(
    "Cranes on one processor",
    "Controllers with SCHED_FIFO on one processor, each at 200 Hz on recorded inputs, with the system calls of the "
    "loop on sockets of its own; their ticks are spread over the period. A number counts as carried when at most one "
    "period in a thousand is missed. The bound divides 95 % of a processor by the load of one live controller.",
    (
        Metric("palms_471_cranes", "Fixed cranes carried", "", "Measured, at most 16."),
        Metric("palms_471_cranes_bound", "Fixed cranes by the bound", "", "From the live load at 200 Hz."),
        Metric("aoro_fc8_cranes", "Forwarders carried", "", "Measured, at most 16."),
        Metric("aoro_fc8_cranes_bound", "Forwarders by the bound", "", "From the live load at 200 Hz."),
        Metric("differing_ticks", "Ticks whose outputs differ from the recording", "", "All controllers.", most=0.0),
    ),
)
SECTIONS: Final = (FAST, COST, CRANES)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)
CONCLUSION: Final = (
    "The whole forwarder runs at 1 kHz with {forwarder1k_cpu_share} of one processor and {forwarder1k_cpu_p50_us} for "
    "a tick in the median.",
    "At 200 Hz one processor carries {palms_471_cranes} fixed cranes or {aoro_fc8_cranes} forwarders.",
)
INTRODUCTION: Final = (
    "The measured controller is the process that runs on the machine, on the testbed of the [timing "
    "experiment](timing.md): guard, emulated machine and wire bus beside it, every control law active."
)


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    setting = f"Commit `{result.commit}`. {host_activity.sentence(result.environment)}"
    return Page("Rates experiment", CONCLUSION, INTRODUCTION, SECTIONS, setting)


def draw(points: Sequence[RatePoint], cranes: Sequence[CranePoint], path: Path) -> None:
    """Load against frames for each machine, and cost against functions for all controllers, with their lines."""
    with sheet(path, 2, height=3.4) as axes:
        for machine, colour in zip(MACHINES, (OIL, MOSS), strict=True):
            frames_per_s, shares = loads(points, machine)
            here = [c for c in cranes if c.machine == machine]
            axes[1].plot([c.functions for c in here], [c.cpu_us for c in here], "o", color=colour, label=machine)
            axes[0].plot(frames_per_s, [100 * share for share in shares], "o", color=colour, label=machine)
            _line(axes[0], frames_per_s, [100 * share for share in shares], colour)
        _line(axes[1], [float(c.functions) for c in cranes], [c.cpu_us for c in cranes], STEEL)
        axes[1].axhline(PERIOD_NS / 1e3, color=RUST, ls="--", lw=0.8)
        axes[0].set(xlabel="frames per second", ylabel="CPU load [%]")
        axes[1].set(xlabel="functions on one processor at 200 Hz", ylabel="CPU time per period [us]")
        for axis in axes:
            axis.legend()


def _line(axis: Any, x: Sequence[float], y: Sequence[float], colour: str) -> None:
    slope, intercept, _ = fit(x, y)
    if math.isfinite(slope):
        ends = np.array([min(x), max(x)])
        axis.plot(ends, slope * ends + intercept, color=colour, lw=1)
