"""Measures this computer for `experiments.timing.fitness`: the timing testbed for a minute, beside cyclictest if there
is one, and a sleep loop."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from can_dbc.bus.factory import VCAN_NAMES
from experiments.timing import evaluation
from experiments.timing.fitness import Figures
from experiments.timing.losses import losses_between
from experiments.timing.measurement import MeasurementWindow, measure, pooled
from experiments.timing.testbed import TestbedConfig, TimingTestbed
from host.doctor.facts import UNLIMITED, Facts, interrupt_counts
from host.doctor.timing import PRIORITY
from host.systemd import process_facts
from host.vcan_lab import links
from machine.loading.profile_file import load_profile

WINDOW_S: Final = 15.0
SETTLE_S: Final = 2.0


@dataclass(frozen=True, slots=True)
class Measured:
    """The figures, and what else a reader of the report asks for."""

    figures: Figures
    bus: str
    profile: str
    cpu: int
    tick: str
    stop_reasons: tuple[str, ...]
    interrupts: dict[str, int]
    """Interrupts of the controller's processor during the measurement, by source; those that occurred."""


def loopback_bus(profile_name: str) -> str:
    """``vcan`` where its interfaces exist and are up, else ``wire``."""
    profile = load_profile(profile_name)
    names = [VCAN_NAMES[b] for b in (profile.crane_bus, profile.machine_bus) if b]
    return "wire" if any(links.state(name) for name in names) else "vcan"


def may_run_cyclictest(facts: Facts) -> bool:
    """Whether cyclictest is installed and this user may give it the controller's priority."""
    limit = facts.rtprio_limit or 0
    allowed = facts.may_prioritise or limit == UNLIMITED or limit >= PRIORITY
    return allowed and shutil.which("cyclictest") is not None


def measure_computer(
    facts: Facts, profile: str, bus: str, seconds: float, directory: Path, show: Callable[[str], None]
) -> Measured:
    """Measure for ``seconds`` in windows of a quarter of a minute; raises CommandFailed when a process does not run."""
    load_before = os.getloadavg()[0] / max(1, len(facts.online))
    count = max(1, round(seconds / WINDOW_S))
    with_cyclictest = may_run_cyclictest(facts)
    setting = TestbedConfig(profile, load_profile(profile).rate_hz, bus)
    show("starting controller, guard and emulated machine")
    with TimingTestbed(setting, directory) as testbed:
        testbed.wait(SETTLE_S)
        controller = testbed.family.children["controller"]
        granted = process_facts(controller.process.pid)
        refused = tuple(
            line.partition("not granted: ")[2]
            for line in controller.errors.read_text().splitlines()
            if "not granted" in line and "timing page" not in line
        )
        before = _interrupts(testbed.cpu)
        windows = []
        for i in range(count):
            show(f"window {i + 1} of {count}, {seconds / count:.0f} s")
            windows.append(measure(testbed, seconds / count, directory, with_cyclictest))
        after = _interrupts(testbed.cpu)
        found = figures_of(
            windows, "cyclictest" if with_cyclictest else "sleep loop", testbed.stops,
            (granted["policy"] == "fifo", int(str(granted["locked_kb"])), refused), load_before,
            facts.machine == "user-mode Linux",
        )  # fmt: skip
        return Measured(
            found, bus, profile, testbed.cpu, windows[-1].end.tick,
            tuple(sorted(reason.name for reason in testbed.stop_reasons)),
            {name: n - before.get(name, 0) for name, n in after.items() if n > before.get(name, 0)},
        )  # fmt: skip


def figures_of(
    windows: list[MeasurementWindow],
    reference: str,
    stops: int,
    granted: tuple[bool, int, tuple[str, ...]],
    load_before: float,
    emulated: bool,
) -> Figures:
    """The figures of all windows; ``granted``: FIFO scheduling, locked memory [kB], what was refused."""
    ours, theirs, plain = evaluation.loops(windows)
    late = evaluation.spread_us("late", ours)
    beside = evaluation.spread_us("reference", theirs if reference == "cyclictest" else plain)
    cost = evaluation.spread_us("tick", pooled([w.durations["cpu"] for w in windows]))
    process = evaluation.process_metrics(windows)
    fifo, locked_kb, refused = granted
    return Figures(
        seconds=sum(w.host.seconds for w in windows),
        period_us=windows[0].end.period_ns / 1e3,
        ticks=sum(w.ticks for w in windows),
        missed=sum(w.missed for w in windows),
        late_p50_us=late["late_p50_us"],
        late_p99_us=late["late_p99_us"],
        late_max_us=late["late_max_us"],
        reference=reference,
        reference_p99_us=beside["reference_p99_us"],
        reference_max_us=beside["reference_max_us"],
        tick_p50_us=cost["tick_p50_us"],
        tick_p99_us=cost["tick_p99_us"],
        frames_lost=sum(loss.frames for loss in losses_between(windows[0].begin, windows[-1].end)),
        page_faults=round(process["page_faults"]),
        gc_runs=round(process["gc_runs"]),
        stops=stops,
        fifo=fifo,
        locked_kb=locked_kb,
        refused=refused,
        steal_ms=sum(w.host.steal_ms for w in windows),
        load_before=load_before,
        emulated=emulated,
    )


def _interrupts(cpu: int) -> dict[str, int]:
    try:
        return interrupt_counts(Path("/proc/interrupts").read_text(), cpu)
    except OSError:
        return {}
