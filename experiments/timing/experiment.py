"""The timing experiment: two testbeds, quiet and loaded windows on each, evaluation, plots and page."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from experiments.common.registry import Options
from experiments.common.result import Result, commit, environment, limits_of
from experiments.common.result_page import Page, publish
from experiments.timing import evaluation, host_activity, plots, reference_loops
from experiments.timing.losses import Loss, Stall, Stop, sentences, stall_before_stop, stall_of_loss
from experiments.timing.measurement import MeasurementWindow, load, measure, pooled, system_calls
from experiments.timing.metrics import CONCLUSION, INTRODUCTION, METRICS, SECTIONS
from experiments.timing.testbed import TestbedConfig, TimingTestbed
from hil.tick.instructions import INSTRUCTIONS, count, open_counter
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile

FORWARDER: Final = "aoro_fc8"
FIXED_CRANE: Final = "palms_471"
FAST_HZ: Final = 1000
FAST_BITRATE: Final = 4_000_000
OVERHEAD_S: Final = 5.0
"""A window waits for cyclictest's full second and for the controller's timing page at both ends."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Number and length [s] of the windows, quiet and loaded, at 200 Hz and 1 kHz; warm-up and tracing time [s]."""

    quiet: int
    quiet_s: float
    loaded: int
    loaded_s: float
    fast: int
    fast_s: float
    warm_s: float
    trace_s: float

    @property
    def seconds(self) -> float:
        """Approximate duration [s]."""
        windows = self.quiet * self._one(self.quiet_s) + self.loaded * self._one(self.loaded_s)
        return windows + 2 * self.fast * self._one(self.fast_s) + 2 * (self.warm_s + 12.0) + self.trace_s + 15.0

    @staticmethod
    def _one(seconds: float) -> float:
        return seconds + OVERHEAD_S


FULL: Final = Plan(24, 24.0, 3, 20.0, 3, 20.0, 10.0, 4.0)
QUICK: Final = Plan(1, 5.0, 1, 3.0, 1, 3.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of one testbed; ``calls``: system calls by name, and the number of ticks that made them."""

    quiet: list[MeasurementWindow]
    loaded: list[MeasurementWindow]
    calls: tuple[dict[str, int], float] | None
    stops: int
    modes: list[str]
    stop_events: Sequence[Stop] = ()
    losses: Sequence[Loss] = ()
    stalls: Sequence[Stall] = ()
    instructions: float = math.nan
    """Instructions of the controller's thread per period over the quiet windows; NaN if the host does not count."""
    others: Mapping[str, float] = field(default_factory=dict)
    """Counters of emulated machine and observer over the whole measurement."""


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs.

    Raises:
        CommandFailed: a tool is missing or a process does not run.
    """
    if missing := reference_loops.missing_tools():
        tools, packages = ", ".join(missing), " ".join(missing.values())
        raise CommandFailed(
            "timing.tools-missing", f"timing needs {tools}: apt-get install {packages}", ExitCode.CONFIGURATION
        )
    plan = QUICK if options.quick else FULL
    machine, crane = machines(options.profile)
    console.print(f"timing: about {plan.seconds / 60:.0f} minutes; keep the machine idle meanwhile")
    slow = measure_testbed(TestbedConfig(machine, load_profile(machine).rate_hz), plan, options.out / "slow", console)
    fast_setting = TestbedConfig(crane, FAST_HZ, bitrates=(("crane0", FAST_BITRATE),))
    fast = measure_testbed(fast_setting, plan, options.out / "fast", console)
    metrics, compared = gather(slow, fast)
    metrics |= frame_costs(options.quick, console) | compiled_ratios(options.quick, console)
    found = evaluation.evaluate(METRICS, metrics, evaluation.undecided(metrics))
    surroundings = host_activity.describe()
    result = Result(
        experiment="timing",
        commit=commit(),
        profile=machine,
        seed=options.seed,
        trials=len(slow.quiet),
        metrics=metrics,
        paper={},
        environment={
            **environment(),
            **surroundings,
            "host_verdict": "quiet enough" if metrics["host_verdict"] else "inconclusive",
            "events": "; ".join(
                f"{hz} Hz: {text}"
                for hz, found in ((200, slow), (FAST_HZ, fast))
                for text in sentences(found.stop_events, found.losses, found.stalls)
            ),
            "instructions": "counted" if "tick_instructions" in metrics else "not counted by this host",
            "tick": compared[-1].end.tick,
            **{f"open: {name}": why for name, why in found.inconclusive.items()},
        },
        limits=limits_of(METRICS),
        missed=found.missed,
        inconclusive=tuple(found.inconclusive),
    )
    options.out.mkdir(parents=True, exist_ok=True)
    durations = {name: pooled([w.durations[name] for w in compared]) for name in compared[0].durations}
    inputs = compared[-1].end.inputs
    plots.draw(evaluation.loops(compared), evaluation.loops(slow.loaded), durations, inputs, options.out)
    publish(result, page_of(result, {}), options, console)
    for name, why in found.inconclusive.items():
        console.print(f"[yellow]inconclusive[/yellow] {name}: {why}", highlight=False, soft_wrap=True)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """The result page."""
    return Page("Timing experiment", CONCLUSION, INTRODUCTION, SECTIONS, setting(result))


def setting(result: Result) -> str:
    """One sentence on what was measured where."""
    e = result.environment
    plan = FULL if result.trials == FULL.quiet else QUICK
    quiet = "The host was quiet enough for the comparison of wake-ups."
    if not result.metrics["host_verdict"]:
        quiet = "The host was too noisy for the comparison of wake-ups, which is therefore **inconclusive**."
    return (
        f"Commit `{result.commit}`; `{result.profile}` on both buses at 200 Hz, quiet windows {plan.quiet} x "
        f"{plan.quiet_s:.0f} s, loaded ones {plan.loaded} x {plan.loaded_s:.0f} s; `{FIXED_CRANE}` at 1 kHz, "
        f"{plan.fast} of {plan.fast_s:.0f} s each. Host: {e['processor']}, {e['cpus']} cores, hypervisor: "
        f"{e['hypervisor']}, kernel {e['kernel']}, preemption {e['preemption']}, clock {e['clock']}, governor "
        f"{e['governor']}, isolated processors {e['isolated']}, Python {e['python']}, tick: "
        f"{e.get('tick', 'interpreter')}. {quiet}"
    )


def machines(profile: str) -> tuple[str, str]:
    """The machine with a carrier for 200 Hz and the fixed crane for 1 kHz; ``profile`` replaces the one of its kind."""
    return (profile, FIXED_CRANE) if load_profile(profile).machine_bus else (FORWARDER, profile)


def measure_testbed(setting: TestbedConfig, plan: Plan, directory: Path, console: Console) -> Measured:
    """Measure all windows of one testbed."""
    slow = setting.rate_hz < FAST_HZ
    n, seconds = (plan.quiet, plan.quiet_s) if slow else (plan.fast, plan.fast_s)
    loaded, loaded_s = (plan.loaded, plan.loaded_s) if slow else (plan.fast, plan.fast_s)
    what = f"{setting.profile} at {setting.rate_hz} Hz"
    with console.status(f"timing: {what}: starting") as status:

        def windows(kind: str, count: int, length_s: float) -> list[MeasurementWindow]:
            done: list[MeasurementWindow] = []
            for i in range(count):
                status.update(f"timing: {what}: {kind} window {i + 1} of {count}{_last(done)}")
                done.append(measure(testbed, length_s, directory))
            return done

        with TimingTestbed(setting, directory) as testbed:
            testbed.wait(plan.warm_s)
            before = _counters(testbed)
            counter = open_counter(testbed.family.children["controller"].process.pid, INSTRUCTIONS)
            executed = count(counter) if counter is not None else 0
            quiet = windows("quiet", n, seconds)
            instructions = math.nan
            if counter is not None:
                passed = quiet[-1].end.ticks - quiet[0].begin.ticks
                instructions = (count(counter) - executed) / max(1, passed)
                os.close(counter)
            with load(testbed, 2 * loaded * (loaded_s + OVERHEAD_S) + 60.0):
                pressed = windows("loaded", loaded, loaded_s)
            testbed.wait(1.0)  # for the last words of every process
            # Read now, because tracing may stop the machine.
            calls, stops, modes = None, len(testbed.stop_events), list(testbed.modes)
            events = list(testbed.stop_events), list(testbed.losses), list(testbed.stalls)
            others = {name: value - before[name] for name, value in _counters(testbed).items()}
            if slow:
                status.update(f"timing: {what}: counting system calls")
                calls = system_calls(testbed, plan.trace_s, directory)
            return Measured(quiet, pressed, calls, stops, modes, *events, instructions, others)


def _counters(testbed: TimingTestbed) -> dict[str, float]:
    """Frames and records that someone other than the controller has lost so far."""
    machine, observer = testbed.status.get("machine", {}), testbed.status.get("observer", {})
    return {
        "machine_frames_lost": float(machine.get("refused_frames", 0) + machine.get("dropped_frames", 0)),
        "machine_stalls": float(machine.get("stalls", 0)),
        "records_lost": float(observer.get("records_lost", 0) + observer.get("records_unreadable", 0)),
    }


def _last(done: Sequence[MeasurementWindow]) -> str:
    if not done:
        return ""
    wake, cpu = (done[-1].durations[name].quantile_ns(0.99) / 1e3 for name in ("wake", "cpu"))
    theirs = done[-1].cyclictest.quantile_ns(0.99) / 1e3
    return f" (p99 of the last: late {wake:.0f} us, cyclictest {theirs:.0f} us, tick {cpu:.0f} us)"


def gather(slow: Measured, fast: Measured) -> tuple[dict[str, float], list[MeasurementWindow]]:
    """All metrics of both testbeds, and the windows that were compared."""
    compared, enough = evaluation.compared_windows(slow.quiet)
    metrics = evaluation.process_metrics(slow.quiet) | evaluation.host_metrics(slow.quiet, enough)
    metrics["period_us"] = slow.quiet[0].end.period_ns / 1e3
    metrics |= evaluation.spread_us("tick", pooled([w.durations["tick"] for w in compared]))
    for name, windows in (("tick_cpu", slow.quiet), ("tick1k_cpu", fast.quiet)):
        judged = evaluation.quietest_windows(windows)
        metrics |= evaluation.spread_us(name, pooled([w.durations["cpu"] for w in judged]))
        everywhere = evaluation.spread_us(name, pooled([w.durations["cpu"] for w in windows]))
        metrics |= {k.replace("cpu_", "cpu_all_"): v for k, v in everywhere.items()}
        metrics[f"{name}_host_still"] = float(all(map(evaluation.still, judged)))
    metrics |= evaluation.host_speed(slow.quiet)
    metrics |= evaluation.spread_us("sample_to_command", pooled([w.durations["sample_to_command"] for w in compared]))
    metrics |= evaluation.wakeups("", compared)
    ours, theirs = [w.durations["wake"] for w in compared], [w.cyclictest for w in compared]
    for name, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        metrics |= evaluation.ratio(f"wakeup_{name}_ratio", ours, theirs, share)
    metrics["judged_cycles"] = float(sum(w.ticks + w.missed for w in compared))
    metrics["missed"] = float(sum(w.missed for w in compared))
    metrics["missed_everywhere"] = float(sum(w.missed for w in slow.quiet))
    metrics |= _renamed(evaluation.wakeups("", slow.loaded), "_", "_loaded_", 1) | loaded("", slow.loaded)
    metrics |= event_metrics(slow, fast)
    if not math.isnan(slow.instructions):
        metrics["tick_instructions"] = slow.instructions
    metrics |= system_call_metrics(slow.calls)
    metrics |= _renamed(evaluation.wakeups("", fast.quiet), "_", "1k_", 1) | loaded("_1k", fast.loaded)
    metrics["ticks_1k"] = float(sum(w.ticks for w in fast.quiet))
    metrics["missed_1k"] = float(sum(w.missed for w in fast.quiet))
    return metrics, compared


def event_metrics(slow: Measured, fast: Measured) -> dict[str, float]:
    """Stops and losses of both testbeds, and how many of them no stall of the host explains."""
    both = (slow, fast)
    lost = sum(x.frames for m in both for x in m.losses)
    explained = sum(x.frames for m in both for x in m.losses if stall_of_loss(x, m.stalls))
    stops = sum(m.stops for m in both)
    caused = sum(stall_before_stop(s, m.stalls) is not None for m in both for s in m.stop_events)
    stalls = [stall for m in both for stall in m.stalls]
    metrics = {
        "frames_lost": float(lost),
        "frames_lost_unexplained": float(lost - explained),
        "stops": float(stops),
        "stops_unexplained": float(stops - caused),
        "stalls": float(len(stalls)),
        "stall_max_ms": max((s.length_ns for s in stalls), default=0) / 1e6,
    }
    for name in ("machine_frames_lost", "machine_stalls", "records_lost"):
        metrics[name] = float(sum(m.others.get(name, 0.0) for m in both))
    return metrics


def compiled_ratios(quick: bool, console: Console) -> dict[str, float]:
    """How many times as fast the compiled tick is, caches cold and hot: the smaller ratio of the kept recordings.

    NaN if there is no compiled tick or no recording.
    """
    from hil.tick import compare

    names = ("compiled_ratio_cold", "compiled_ratio_hot")
    with console.status("timing: interpreter and compiled tick") as status, tempfile.TemporaryDirectory() as folder:
        try:
            compare.need_build()
            places = compare.kept_recordings(Path(folder))
        except CommandFailed as error:
            console.print(f"timing: no ratio: {error}", highlight=False, soft_wrap=True)
            return dict.fromkeys(names, math.nan)
        ticks, rounds = (300, 1) if quick else (2000, 3)
        rows = [compare.compare_cost(place, ticks, rounds, status.update) for place in places]
    return {name: float(min(row[name] for row in rows)) for name in names}


def _renamed(metrics: Mapping[str, float], old: str, new: str, count: int) -> dict[str, float]:
    return {name.replace(old, new, count): value for name, value in metrics.items()}


def loaded(end: str, windows: Sequence[MeasurementWindow]) -> dict[str, float]:
    """Missed deadlines of the three loops under load; ``end`` is the suffix of the metric names."""
    ours = sum(w.missed for w in windows)
    plain = sum(w.sleep_loop.missed for w in windows)
    theirs = sum(w.cyclictest.periods(w.end.period_ns) for w in windows)
    return {
        f"missed_loaded{end}": float(ours),
        f"missed_loaded_plain{end}": float(plain),
        f"missed_loaded_cyclictest{end}": float(theirs),
        f"missed_loaded{end}_share": ours / plain if plain else math.nan,
        f"cycles_loaded{end}": float(sum(w.ticks + w.missed for w in windows)),
    }


def system_call_metrics(calls: tuple[dict[str, int], float] | None) -> dict[str, float]:
    """System calls per tick, in total and by name; NaN if the process cannot be traced."""
    if calls is None:
        return {"syscalls_per_tick": math.nan}
    by_name, ticks = calls
    each = {f"syscalls_{name}": count / ticks for name, count in by_name.items()}
    return {"syscalls_per_tick": sum(by_name.values()) / ticks, **each}


def frame_costs(quick: bool, console: Console) -> dict[str, float]:
    """Cost of receiving one frame, with a raw socket and with python-can, on this host."""
    from experiments.timing import receive_cost

    frames, rounds = (1_000, 3) if quick else (10_000, 9)
    with console.status("timing: cost of a frame"):
        found: dict[str, float] = receive_cost.measure(frames, rounds)["metrics"]
    return found
