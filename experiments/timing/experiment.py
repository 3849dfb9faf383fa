"""The timing experiment: two stands, quiet and loaded windows on each, figures, verdicts, pictures, page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console

from experiments.common.registry import Options
from experiments.common.result import Result, commit, environment
from experiments.common.result_page import tell
from experiments.timing import evaluation, host_activity, plots, reference_loops
from experiments.timing.measurement import Window, load, measure, pooled, system_calls
from experiments.timing.metrics import FIGURES, SECTIONS
from experiments.timing.testbed import Setting, Stand
from host.exit_codes import CommandFailed, ExitCode
from machine.load import load_profile

FORWARDER: Final = "aoro_fc8"
FIXED_CRANE: Final = "palms_471"
FAST_HZ: Final = 1000
FAST_BITRATE: Final = 4_000_000
OVERHEAD_S: Final = 5.0
"""A window waits for cyclictest's full second and for the controller's page at either end."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Windows and their length [s], quiet and loaded, at 200 Hz and at 1 kHz; seconds of warming up and of tracing."""

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
        """How long it takes, roughly."""
        windows = self.quiet * self._one(self.quiet_s) + self.loaded * self._one(self.loaded_s)
        return windows + 2 * self.fast * self._one(self.fast_s) + 2 * (self.warm_s + 12.0) + self.trace_s + 15.0

    @staticmethod
    def _one(seconds: float) -> float:
        return seconds + OVERHEAD_S


FULL: Final = Plan(24, 24.0, 3, 20.0, 3, 20.0, 10.0, 4.0)
QUICK: Final = Plan(1, 5.0, 1, 3.0, 1, 3.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Measured:
    """What one stand gave; ``calls``: system calls by name and the ticks in which they were made."""

    quiet: list[Window]
    loaded: list[Window]
    calls: tuple[dict[str, int], float] | None
    stops: int
    modes: list[str]


def run(options: Options, console: Console) -> Result:
    """Measure everything; writes ``options.out`` and, when asked, the docs.

    Raises:
        Stopped: a tool is missing or a process does not run.
    """
    if missing := reference_loops.missing_tools():
        tools, packages = ", ".join(missing), " ".join(missing.values())
        raise Stopped(Exit.CONFIGURATION, f"timing needs {tools}: apt-get install {packages}")
    plan = QUICK if options.quick else FULL
    machine, crane = machines(options.profile)
    console.print(f"timing: about {plan.seconds / 60:.0f} minutes; let the machine be quiet meanwhile")
    slow = on_stand(Setting(machine, load_profile(machine).rate_hz), plan, options.out / "slow", console)
    fast_setting = Setting(crane, FAST_HZ, bitrates=(("crane0", FAST_BITRATE),))
    fast = on_stand(fast_setting, plan, options.out / "fast", console)
    metrics, judged = gather(slow, fast)
    metrics |= frame_costs(options.quick, console)
    found = evaluation.judge(FIGURES, metrics, evaluation.untold(metrics))
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
            "modes": "; ".join(slow.modes + fast.modes),
            **{f"open: {name}": why for name, why in found.inconclusive.items()},
        },
        limits={f.name: (f.least, f.most) for f in FIGURES if f.least is not None or f.most is not None},
        missed=found.missed,
        inconclusive=tuple(found.inconclusive),
    )
    options.out.mkdir(parents=True, exist_ok=True)
    durations = {name: pooled([w.durations[name] for w in judged]) for name in judged[0].durations}
    inputs = judged[-1].end.inputs
    plots.draw(evaluation.loops(judged), evaluation.loops(slow.loaded), durations, inputs, options.out)
    tell(result, "Timing, measured", INTRODUCTION, SECTIONS, options, console, setting(result, plan))
    for name, why in found.inconclusive.items():
        console.print(f"[yellow]inconclusive[/yellow] {name}: {why}", highlight=False, soft_wrap=True)
    return result


INTRODUCTION: Final = (
    "The controller that runs here is the process that runs on the machine: `python -m controller`, SCHED_FIFO, locked "
    "memory, beside the real guard, on the wire. Around it stands every CAN node of the machine on joints that follow "
    "their valves, so that the host's processors are left to what is measured. `timberhand experiment timing --docs "
    "docs` measures everything and writes the page; no number is typed."
)


def setting(result: Result, plan: Plan) -> str:
    """What was measured where."""
    e = result.environment
    return (
        f"Commit `{result.commit}`; `{FORWARDER}` on both buses at 200 Hz, quiet windows {plan.quiet} x "
        f"{plan.quiet_s:.0f} s, loaded ones {plan.loaded} x {plan.loaded_s:.0f} s; `{FIXED_CRANE}` at 1 kHz, "
        f"{plan.fast} of {plan.fast_s:.0f} s each. Host: {e['processor']}, {e['cpus']} cores, hypervisor: "
        f"{e['hypervisor']}, kernel {e['kernel']}, preemption {e['preemption']}, clock {e['clock']}, governor "
        f"{e['governor']}, isolated processors {e['isolated']}, Python {e['python']}. Verdict on the host: "
        f"**{e['host_verdict']}**."
    )


def machines(profile: str) -> tuple[str, str]:
    """The machine with a carrier for 200 Hz and the fixed crane for 1 kHz; a profile given takes its place."""
    return (profile, FIXED_CRANE) if load_profile(profile).machine_bus else (FORWARDER, profile)


def on_stand(setting: Setting, plan: Plan, directory: Path, console: Console) -> Measured:
    """All windows of one stand."""
    slow = setting.rate_hz < FAST_HZ
    n, seconds = (plan.quiet, plan.quiet_s) if slow else (plan.fast, plan.fast_s)
    loaded, loaded_s = (plan.loaded, plan.loaded_s) if slow else (plan.fast, plan.fast_s)
    what = f"{setting.profile} at {setting.rate_hz} Hz"
    with console.status(f"timing: {what}: starting") as status:

        def windows(kind: str, count: int, length_s: float) -> list[Window]:
            done: list[Window] = []
            for i in range(count):
                status.update(f"timing: {what}: {kind} window {i + 1} of {count}{_last(done)}")
                done.append(measure(stand, length_s, directory))
            return done

        with Stand(setting, directory) as stand:
            stand.wait(plan.warm_s)
            quiet = windows("quiet", n, seconds)
            with load(stand, 2 * loaded * (loaded_s + OVERHEAD_S) + 60.0):
                pressed = windows("loaded", loaded, loaded_s)
            calls, stops, modes = None, stand.stops, list(stand.modes)  # tracing may stop the machine
            if slow:
                status.update(f"timing: {what}: counting system calls")
                calls = system_calls(stand, plan.trace_s, directory)
            return Measured(quiet, pressed, calls, stops, modes)


def _last(done: Sequence[Window]) -> str:
    if not done:
        return ""
    wake, cpu = (done[-1].durations[name].quantile_ns(0.99) / 1e3 for name in ("wake", "cpu"))
    theirs = done[-1].cyclictest.quantile_ns(0.99) / 1e3
    return f" (p99 of the last: late {wake:.0f} us, cyclictest {theirs:.0f} us, tick {cpu:.0f} us)"


def gather(slow: Measured, fast: Measured) -> tuple[dict[str, float], list[Window]]:
    """All metrics of the stands, and the quiet windows that were judged."""
    judged, enough = evaluation.chosen(slow.quiet)
    metrics = evaluation.per_tick(slow.quiet) | evaluation.of_host(slow.quiet, enough)
    metrics["period_us"] = slow.quiet[0].end.period_ns / 1e3
    for stage in ("cpu", "tick"):
        name = "tick_cpu" if stage == "cpu" else "tick"
        metrics |= evaluation.spread_us(name, pooled([w.durations[stage] for w in judged]))
    metrics |= evaluation.spread_us("sample_to_command", pooled([w.durations["sample_to_command"] for w in judged]))
    metrics |= evaluation.wakeups("", judged)
    ours, theirs = [w.durations["wake"] for w in judged], [w.cyclictest for w in judged]
    for name, share in (("p50", 0.5), ("p99", 0.99), ("p999", 0.999)):
        metrics |= evaluation.ratio(f"wakeup_{name}_ratio", ours, theirs, share)
    metrics["judged_cycles"] = float(sum(w.ticks + w.missed for w in judged))
    metrics["missed"] = float(sum(w.missed for w in judged))
    metrics["missed_everywhere"] = float(sum(w.missed for w in slow.quiet))
    metrics |= _renamed(evaluation.wakeups("", slow.loaded), "_", "_loaded_", 1) | loaded("", slow.loaded)
    metrics["stops"] = float(slow.stops + fast.stops)
    metrics |= system_call_metrics(slow.calls)
    metrics |= evaluation.spread_us("tick1k_cpu", pooled([w.durations["cpu"] for w in fast.quiet]))
    metrics |= _renamed(evaluation.wakeups("", fast.quiet), "_", "1k_", 1) | loaded("_1k", fast.loaded)
    metrics["ticks_1k"] = float(sum(w.ticks for w in fast.quiet))
    metrics["missed_1k"] = float(sum(w.missed for w in fast.quiet))
    return metrics, judged


def _renamed(metrics: Mapping[str, float], old: str, new: str, count: int) -> dict[str, float]:
    return {name.replace(old, new, count): value for name, value in metrics.items()}


def loaded(end: str, windows: Sequence[Window]) -> dict[str, float]:
    """Missed deadlines of the three loops under load; ``end`` is the end of the metrics' names."""
    ours = sum(w.missed for w in windows)
    plain = sum(w.plain.missed for w in windows)
    theirs = sum(w.cyclictest.periods(w.end.period_ns) for w in windows)
    return {
        f"missed_loaded{end}": float(ours),
        f"missed_loaded_plain{end}": float(plain),
        f"missed_loaded_cyclictest{end}": float(theirs),
        f"missed_loaded{end}_share": ours / plain if plain else math.nan,
        f"cycles_loaded{end}": float(sum(w.ticks + w.missed for w in windows)),
    }


def system_call_metrics(calls: tuple[dict[str, int], float] | None) -> dict[str, float]:
    """Calls per tick, in all and of each kind; NaN where nobody may trace."""
    if calls is None:
        return {"syscalls_per_tick": math.nan}
    by_name, ticks = calls
    each = {f"syscalls_{name}": count / ticks for name, count in by_name.items()}
    return {"syscalls_per_tick": sum(by_name.values()) / ticks, **each}


def frame_costs(quick: bool, console: Console) -> dict[str, float]:
    """Cost of one frame, raw and through python-can, on this host."""
    from experiments.timing import receive_cost

    frames, rounds = (1_000, 3) if quick else (10_000, 9)
    with console.status("timing: cost of a frame"):
        found: dict[str, float] = receive_cost.measure(frames, rounds)["metrics"]
    return found
