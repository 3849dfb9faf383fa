"""Judges whether a computer is fit to run the control loop: a minute on the timing testbed, verdicts, and a report.

Beside the controller run cyclictest, if there is one, and a sleep loop.

A bad figure that depends on the clock is *inconclusive* when the computer was disturbed meanwhile; a good one stays
good.  The limits are shares of the control period.  The report is one Markdown file with its data as JSON inside, made
to be sent: every text passes `without_private`, which removes names of host and user and paths that are not the
system's own.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from can_dbc.bus.factory import VCAN_NAMES
from experiments.timing.events import losses_between
from experiments.timing.measurement import measure
from experiments.timing.metrics import loops, pooled, process_metrics, spread_us
from experiments.timing.testbed import TestbedConfig, TimingTestbed
from host.doctor.facts import UNLIMITED, Computer, Facts, interrupt_counts
from host.doctor.finding import Finding, Severity
from host.doctor.timing import PRIORITY
from host.systemd import process_facts
from host.vcan_lab import links
from machine.loading.profile_file import load_profile

WINDOW_S: Final = 15.0
SETTLE_S: Final = 2.0
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


@dataclass(frozen=True, slots=True)
class Measured:
    """The figures, and what else a reader asks for; ``interrupts`` of the controller's processor, by source."""

    figures: Figures
    bus: str
    profile: str
    cpu: int
    tick: str
    stop_reasons: tuple[str, ...]
    interrupts: dict[str, int]


def loopback_bus(profile_name: str) -> str:
    """Choose ``vcan`` where its interfaces exist and are up, else ``wire``."""
    profile = load_profile(profile_name)
    names = [VCAN_NAMES[b] for b in (profile.crane_bus, profile.machine_bus) if b]
    return "wire" if any(links.state(name) for name in names) else "vcan"


def may_run_cyclictest(facts: Facts) -> bool:
    """Tell whether cyclictest is installed and this user may give it the controller's priority."""
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
        error_lines = [line for line in controller.errors.read_text().splitlines() if "timing page" not in line]
        before, windows = _interrupts(testbed.cpu), []
        for i in range(count):
            show(f"window {i + 1} of {count}, {seconds / count:.0f} s")
            windows.append(measure(testbed, seconds / count, directory, with_cyclictest))
        after = _interrupts(testbed.cpu)
    ours, theirs, plain = loops(windows)
    process, stops = process_metrics(windows), testbed.events.stops
    times_us = {
        **spread_us("late", ours),
        **spread_us("reference", theirs if with_cyclictest else plain),
        **spread_us("tick", pooled([w.durations["cpu"] for w in windows])),
    }
    figures = Figures(
        seconds=sum(w.host.seconds for w in windows),
        period_us=setting.period_ns / 1e3,
        ticks=sum(w.ticks for w in windows),
        missed=sum(w.missed for w in windows),
        **{name: us for name, us in times_us.items() if name in Figures.__slots__},
        reference="cyclictest" if with_cyclictest else "sleep loop",
        frames_lost=sum(loss.frames for loss in losses_between(windows[0].begin, windows[-1].end)),
        page_faults=round(process["page_faults"]),
        gc_runs=round(process["gc_runs"]),
        stops=len(stops),
        fifo=granted["policy"] == "fifo",
        locked_kb=int(str(granted["locked_kb"])),
        refused=tuple(line.partition("not granted: ")[2] for line in error_lines if "not granted" in line),
        steal_ms=sum(w.host.steal_ms for w in windows),
        load_before=load_before,
        emulated=facts.machine == "user-mode Linux",
    )
    reasons = tuple(sorted({stop.reason for stop in stops}))
    interrupts = {name: n - before.get(name, 0) for name, n in after.items() if n > before.get(name, 0)}
    return Measured(figures, bus, profile, testbed.cpu, windows[-1].end.tick, reasons, interrupts)


def _interrupts(cpu: int) -> dict[str, int]:
    path = Path("/proc/interrupts")
    return interrupt_counts(path.read_text(), cpu) if os.access(path, os.R_OK) else {}


def disturbances(f: Figures) -> list[str]:
    """List why clocked figures cannot be held against this computer; empty when it was left alone."""
    reasons = []
    if f.emulated:
        reasons.append("this kernel runs as a process of another one")
    if f.steal_ms > STEAL_SHARE * 1e3 * f.seconds:
        reasons.append(f"the hypervisor took {f.steal_ms:.0f} ms in {f.seconds:.0f} s")
    if f.load_before > BUSY_SHARE:
        reasons.append(f"other programs were running (load {f.load_before:.1f} per processor)")
    return reasons


def judge(f: Figures) -> tuple[Judgement, ...]:
    """Judge all topics."""
    late = "the controller read too late: first correct wake-ups and rights; else send this report"
    stopped = "the reasons are under 'stop_reasons'; correct wake-ups first"
    return (
        rights(f),
        wakeups(f),
        tick_cost(f),
        _clocked(f, "frames", _graded(f.frames_lost), f"{f.frames_lost} frames were lost", late),
        memory(f),
        _clocked(f, "stops", _graded(f.stops), f"the supervisor stopped the machine {f.stops} times", stopped),
    )


def overall(found: Iterable[Judgement]) -> Verdict:
    """Find the worst verdict."""
    order = list(Verdict)
    return max((j.verdict for j in found), key=order.index, default=Verdict.INCONCLUSIVE)


def _clocked(f: Figures, topic: str, verdict: Verdict, said: str, advice: str) -> Judgement:
    """Give a verdict that depends on the clock: what is not good is inconclusive where the computer was disturbed."""
    if verdict is Verdict.GOOD:
        return Judgement(topic, verdict, said)
    if why := disturbances(f):
        advice = "end other programs, or use a computer without a hypervisor, and measure again"
        return Judgement(topic, Verdict.INCONCLUSIVE, f"{said}; {' and '.join(why)}", advice)
    return Judgement(topic, verdict, said, advice)


def _graded(share: float, good: float = 0.0, marginal: float = 0.0) -> Verdict:
    return Verdict.GOOD if share <= good else Verdict.MARGINAL if share <= marginal else Verdict.UNFIT


def rights(f: Figures) -> Judgement:
    """Judge FIFO scheduling and locked memory."""
    if f.fifo and f.locked_kb and not f.refused:
        sentence = f"the controller runs with SCHED_FIFO and {f.locked_kb >> 10} MB of locked memory"
        return Judgement("rights", Verdict.GOOD, sentence)
    sentence = f"the system refused: {'; '.join(f.refused) or 'no real-time priority or no locked memory'}"
    advice = "run the report with sudo, or give this user the limits of the service (topics priority and memory below)"
    return Judgement("rights", Verdict.UNFIT, sentence, advice)


def wakeups(f: Figures) -> Judgement:
    """Judge the lateness of the wake-ups, and deadlines missed."""
    sentence = (
        f"{f.missed} of {f.ticks + f.missed} deadlines missed; late by {f.late_p50_us:.0f} us in the median, "
        f"{f.late_p99_us:.0f} at p99, {f.late_max_us:.0f} at most; {f.reference} {f.reference_max_us:.0f} at most"
    )
    if math.isnan(f.late_max_us):
        return Judgement("wake-ups", Verdict.INCONCLUSIVE, "no tick was measured", "measure again")
    verdict = _graded(f.late_max_us / f.period_us, GOOD_LATE_SHARE, MARGINAL_LATE_SHARE)
    if verdict is Verdict.GOOD and not f.missed and f.ticks < MIN_TICKS:
        advice = f"measure longer: a good verdict needs {MIN_TICKS} ticks"
        return Judgement("wake-ups", Verdict.INCONCLUSIVE, sentence, advice)
    if f.reference_max_us >= SAME_SHARE * f.late_max_us:
        advice = f"{f.reference} was late, too: kernel, firmware or drivers; the settings below, the first one first"
    elif not f.fifo:
        advice = "the controller had no real-time priority; see the topic rights"
    else:
        advice = f"{f.reference} was not late: this is the controller's own; send this report"
    return _clocked(f, "wake-ups", Verdict.UNFIT if f.missed else verdict, sentence, advice)


def tick_cost(f: Figures) -> Judgement:
    """Judge the CPU time of a tick; other programs raise it, because they use the caches."""
    if math.isnan(f.tick_p99_us):
        return Judgement("tick", Verdict.INCONCLUSIVE, "no tick was measured", "measure again")
    sentence = f"a tick takes {f.tick_p50_us:.0f} us of CPU time in the median, {f.tick_p99_us:.0f} at p99"
    advice = "compile the tick (timberhand compile), set the governor to performance, or use a faster processor"
    verdict = _graded(f.tick_p99_us / f.period_us, GOOD_TICK_SHARE, MARGINAL_TICK_SHARE)
    return _clocked(f, "tick", verdict, sentence, advice)


def memory(f: Figures) -> Judgement:
    """Judge page faults and garbage collections while it ran."""
    sentence = f"{f.page_faults} page faults, {f.gc_runs} runs of the garbage collector"
    if not f.page_faults and not f.gc_runs:
        return Judgement("memory", Verdict.GOOD, sentence)
    advice = "memory was locked, so this should be 0: send this report"
    if f.page_faults and not f.locked_kb:
        advice = "memory is not locked; see the topic rights"
    return Judgement("memory", Verdict.MARGINAL, sentence, advice)


REMOVED: Final = "(removed)"
_PATH: Final = re.compile(r"(?<![\w.:/])/(?!(?:etc|proc|sys|dev)\b)\w[^\s'\"`,;)|]*/[^\s'\"`,;)|]*")
_COMMON: Final = frozenset({"root", "localhost", ""})
VERSION: Final = 1


def private_words(*words: str) -> frozenset[str]:
    """List the words to remove from a report, for example names of host and user; common ones say nothing and stay."""
    return frozenset(words) - _COMMON


def without_private(value: Any, words: Iterable[str]) -> Any:
    """Remove ``words`` and paths outside the system's own folders from every text of a plain value."""
    if isinstance(value, str):
        text = _PATH.sub(REMOVED, value)
        for word in sorted(words, key=len, reverse=True):
            text = re.sub(rf"(?<!\w){re.escape(word)}(?!\w)", REMOVED, text)
        return text
    if isinstance(value, Mapping):
        return {str(key): without_private(inner, words) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_private(inner, words) for inner in value]
    if isinstance(value, frozenset | set):
        return sorted(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def data_of(
    facts: Facts, computer: Computer, findings: Sequence[Finding], measured: Measured | str, words: Iterable[str]
) -> dict[str, Any]:
    """Gather the data of a report; ``measured`` is a sentence when the measurement failed, ``words`` are removed."""
    if isinstance(measured, str):
        advice = "correct what the sentence and the settings below say, and measure again; else send this report"
        judged: tuple[Judgement, ...] = (Judgement("run", Verdict.UNFIT, measured, advice),)
        more: dict[str, Any] = {"measured": None, "disturbed": []}
    else:
        judged = judge(measured.figures)
        more = {"measured": asdict(measured), "disturbed": disturbances(measured.figures)}
    data = {
        "report": VERSION,
        "verdict": overall(judged).value,
        "judgements": [asdict(j) for j in judged],
        **more,
        "computer": asdict(computer),
        "settings": asdict(facts),
        "findings": [f.document() for f in findings],
    }
    public_data: dict[str, Any] = without_private(data, words)
    return public_data


def text_of(data: dict[str, Any]) -> str:
    """Write the report of these data."""
    lines = ["# Real-time report", "", f"Verdict: **{data['verdict']}**.", ""]
    if data["disturbed"]:
        lines += [f"The computer was disturbed: {'; '.join(data['disturbed'])}.", ""]
    lines += ["| topic | verdict | found | what to do |", "|---|---|---|---|"]
    for j in data["judgements"]:
        lines.append(f"| {j['topic']} | **{j['verdict']}** | {_cell(j['sentence'])} | {_cell(j['advice'])} |")
    lines += ["", "## Computer", "", "| fact | value |", "|---|---|"]
    parts = [data["computer"], data["settings"], data["measured"] or {}, (data["measured"] or {}).get("figures", {})]
    lines += [f"| {name} | {_cell(value)} |" for part in parts for name, value in part.items() if name != "figures"]
    lines += ["", "## Settings to change, the most useful first", ""]
    changes = [f for f in data["findings"] if f["severity"] != Severity.FINE.name.lower()]
    for f in changes:
        lines.append(f"- {f['what']}: {f['sentence']}; gain: {f['gain']}")
        lines += [f"  - `{command}`" for command in f["commands"]]
    lines += [] if changes else ["None."]
    lines += ["", "## Data", "", "```json", json.dumps(data, indent=1), "```", ""]
    return "\n".join(lines)


def read_data(text: str) -> dict[str, Any]:
    """Read the data inside a report; raises ValueError when there are none."""
    match = re.search(r"^```json\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    if match is None:
        raise ValueError("this is not a real-time report: it holds no JSON")
    data: dict[str, Any] = json.loads(match[1])
    return data


def _cell(value: object) -> str:
    """Write the content of a table cell, lists as words; a line feed or a column's mark would end the cell."""
    text = ", ".join(map(str, value)) if isinstance(value, list | dict) else str(value)
    return text.replace("|", "\\|").replace("\n", " ")
