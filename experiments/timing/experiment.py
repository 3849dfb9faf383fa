"""The timing experiment: two testbeds, quiet and loaded windows on each, metrics, plots and page."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Final, NamedTuple

from rich.console import Console

from experiments.common import host_activity
from experiments.common.registry import Options
from experiments.common.result import Result, make_result
from experiments.common.result_page import Page, publish
from experiments.timing import metrics, plots, receive_cost
from experiments.timing.measurement import MeasurementWindow, load, measure, missing_tools, system_calls
from experiments.timing.metrics import METRICS, OTHERS, Measured
from experiments.timing.testbed import TestbedConfig, TimingTestbed
from hil.tick import compare
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile

FORWARDER: Final = "aoro_fc8"
FIXED_CRANE: Final = "palms_471"
FAST_HZ: Final = 1000
FAST_BITRATE: Final = 4_000_000
OVERHEAD_S: Final = 5.0
"""A window waits for cyclictest's full second and for the controller's timing page at both ends."""


class Plan(NamedTuple):
    """Number and length [s] of the windows of one testbed, quiet and loaded; warm-up and tracing time [s]."""

    quiet: int
    quiet_s: float
    loaded: int
    loaded_s: float
    warm_s: float
    trace_s: float = 0.0

    @property
    def seconds(self) -> float:
        """Approximate duration [s]."""
        windows_s = self.quiet * (self.quiet_s + OVERHEAD_S) + self.loaded * (self.loaded_s + OVERHEAD_S)
        return windows_s + self.warm_s + self.trace_s + 20.0


FULL: Final = Plan(24, 24.0, 3, 20.0, 10.0, 4.0), Plan(3, 20.0, 3, 20.0, 10.0)
QUICK: Final = Plan(1, 5.0, 1, 3.0, 1.0, 1.0), Plan(1, 3.0, 1, 3.0, 1.0)
"""At 200 Hz and at 1 kHz."""


def run(options: Options, console: Console) -> Result:
    """Run the experiment; write ``options.out`` and, if requested, the docs; a missing tool raises CommandFailed."""
    if missing := missing_tools():
        raise CommandFailed(
            "timing.tools-missing",
            f"timing needs {', '.join(missing)}: apt-get install {' '.join(missing.values())}",
            ExitCode.CONFIGURATION,
        )
    plans = QUICK if options.quick else FULL
    machine, crane = machines(options.profile)
    console.print(f"timing: about {sum(p.seconds for p in plans) / 60:.0f} minutes; keep the machine idle meanwhile")
    setting = TestbedConfig(machine, load_profile(machine).rate_hz)
    slow = measure_testbed(setting, plans[0], options.out / "slow", console)
    setting = TestbedConfig(crane, FAST_HZ, bitrates=(("crane0", FAST_BITRATE),))
    fast = measure_testbed(setting, plans[1], options.out / "fast", console)
    measured_values, compared = metrics.gather(slow, fast)
    with console.status("timing: cost of a frame, interpreter and compiled tick") as status:
        measured_values |= receive_cost.measure(*((1_000, 3) if options.quick else (10_000, 9)))["metrics"]
        measured_values |= compiled_ratios(options.quick, status.update, console)
    undecided = metrics.undecided(measured_values)
    result = make_result(
        "timing",
        METRICS,
        measured_values,
        profile=machine,
        seed=options.seed,
        trials=len(slow.quiet),
        more={
            **host_activity.describe(),
            "host_verdict": "quiet enough" if measured_values["host_verdict"] else "inconclusive",
            "events": "; ".join([*slow.events.sentences("200 Hz"), *fast.events.sentences(f"{FAST_HZ} Hz")]),
            "instructions": "counted" if "tick_instructions" in measured_values else "not counted by this host",
            "tick": compared[-1].end.tick,
        },
        undecided=undecided,
    )
    options.out.mkdir(parents=True, exist_ok=True)
    plots.draw(compared, slow.loaded, options.out)
    publish(result, page_of(result, {}), options, console)
    for name in result.inconclusive:
        console.print(f"[yellow]inconclusive[/yellow] {name}: {undecided[name]}", highlight=False, soft_wrap=True)
    return result


def page_of(result: Result, trials: Mapping[str, Any]) -> Page:
    """Make the result page."""
    slow, fast = FULL if result.trials == FULL[0].quiet else QUICK
    quiet = "The host was quiet enough for the comparison of wake-ups."
    if not result.metrics["host_verdict"]:
        quiet = "The host was too noisy for the comparison of wake-ups, which is therefore **inconclusive**."
    setting = (
        f"Commit `{result.commit}`; `{result.profile}` on both buses at 200 Hz, quiet windows {slow.quiet} x "
        f"{slow.quiet_s:.0f} s, loaded ones {slow.loaded} x {slow.loaded_s:.0f} s; `{FIXED_CRANE}` at 1 kHz, "
        f"{fast.quiet} of {fast.quiet_s:.0f} s each. {host_activity.sentence(result.environment)} {quiet}"
    )
    return Page("Timing experiment", metrics.CONCLUSION, metrics.INTRODUCTION, metrics.SECTIONS, setting)


def machines(profile: str) -> tuple[str, str]:
    """Choose a machine with carrier for 200 Hz, a fixed crane for 1 kHz; ``profile`` replaces the one of its kind."""
    return (profile, FIXED_CRANE) if load_profile(profile).machine_bus else (FORWARDER, profile)


def measure_testbed(setting: TestbedConfig, plan: Plan, directory: Path, console: Console) -> Measured:
    """Measure all windows of one testbed."""
    title = f"timing: {setting.profile} at {setting.rate_hz} Hz"
    with console.status(f"{title}: starting") as status, TimingTestbed(setting, directory) as testbed:

        def windows(kind: str, number: int, length_s: float) -> Iterator[MeasurementWindow]:
            for i in range(number):
                status.update(f"{title}: {kind} window {i + 1} of {number}")
                yield measure(testbed, length_s, directory)

        testbed.wait(plan.warm_s)
        before = testbed.counters()
        quiet = list(windows("quiet", plan.quiet, plan.quiet_s))
        with load(testbed, 2 * plan.loaded * (plan.loaded_s + OVERHEAD_S) + 60.0):
            pressed = list(windows("loaded", plan.loaded, plan.loaded_s))
        testbed.wait(1.0)  # for the last words of every process
        after = testbed.counters()
        events = deepcopy(testbed.events)  # now, because tracing may stop the machine
        others = {name: float(after[name] - before[name]) for name in OTHERS}
        status.update(f"{title}: counting system calls")
        calls = system_calls(testbed, plan.trace_s, directory) if plan.trace_s else None
        return Measured(quiet, pressed, calls, events, others)


def compiled_ratios(quick: bool, progress: Callable[[str], None], console: Console) -> dict[str, float]:
    """Measure how many times as fast the compiled tick is, caches cold and hot: the smaller ratio of the recordings.

    NaN if there is no compiled tick or no recording.
    """
    names = ("compiled_ratio_cold", "compiled_ratio_hot")
    with tempfile.TemporaryDirectory() as folder:
        try:
            compare.need_build()
            recordings = compare.kept_recordings(Path(folder))
        except CommandFailed as error:
            console.print(f"timing: no ratio: {error}", highlight=False, soft_wrap=True)
            return dict.fromkeys(names, math.nan)
        ticks, rounds = (300, 1) if quick else (2000, 3)
        rows = [compare.compare_cost(recording, ticks, rounds, progress) for recording in recordings]
    return {name: float(min(row[name] for row in rows)) for name in names}
