"""The pages of the fault campaign: a summary table, and one evidence page for each entry."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from experiments.common.result import Result
from experiments.common.result_page import Section
from experiments.faults.metrics import CAMPAIGN, HOUR_S, NOMINAL, case_prefix, injections_of
from experiments.faults.separation import EDGES, merged
from hil.faults.catalogue import CASES, Case

CONCLUSION: Final = (
    "{injections} injections of {cases} faults: {unexplained} are missed outside the named blind spots, and "
    "{blind_missed} inside them.",
    "After the loss of a needed input the valves of the crane's joints and the drive are neutral within "
    "{neutral_max_ms}.",
    "In {nominal_hours} of work without a fault the machine stopped {false_trips} times.",
)
INTRODUCTION: Final = (
    "Every entry of the fault catalogue ([safety](reference/safety.md) section 5) is injected at random moments into a "
    "moving machine in lockstep: both machines, crane work and driving, over CAN and through a PLC where the fault "
    "exists there. Faults of oil, steel and load act on the plant with physics, all others on the kinematic machine. "
    "Many injections are forked from one running machine; each is drawn from its own seed. Detection is observed from "
    "outside: the mode and reason to which the recorded ticks replay, the frames on the buses, and the counters of the "
    "reports. *Tip astray* is the greatest distance of the hanger pin from its reference while the machine is active, "
    "and its whole way after that; while driving it is only that way, of the front axle. A bound is a fault detection "
    "time; one tick is added, because a fault between ticks is met by the next. **Blind spots were named after first "
    "runs of the campaign had missed these injections**: works, verdicts and greatest harm are in "
    "`hil/faults/catalogue.py`."
)
_EMPTY: Final = "–"


def sections(result: Result) -> tuple[Section, ...]:
    """Make the sections of the summary page."""
    return (
        Section("Campaign", "", CAMPAIGN),
        Section("Work without faults", "", NOMINAL),
        Section("All entries", table(result.metrics), ()),
        Section("Missed injections and blind spots", blind_spots(result.metrics), ()),
    )


def table(metrics: Mapping[str, float]) -> str:
    """Write one line for each entry."""
    lines = [
        "| # | fault | promised | injections | missed | detection p50 / p99 / max ms | neutral ms | tip travel m "
        "| tip astray m |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for case in CASES:
        p = case_prefix(case)
        times = " / ".join(_number(metrics.get(f"{p}_{key}_ms")) for key in ("p50", "p99", "max"))
        lines.append(
            f"| {case.number} | [{case.title}](results/faults/{case.label}.md) | {case.reaction}, {case.bound} "
            f"| {_number(metrics.get(f'{p}_injections'))} | {_number(metrics.get(f'{p}_missed'))} | {times} "
            f"| {_number(metrics.get(f'{p}_neutral_max_ms'))} | {_number(metrics.get(f'{p}_travel_max_m'))} "
            f"| {_number(metrics.get(f'{p}_astray_max_m'))} |"
        )
    return "\n".join(lines)


def blind_spots(metrics: Mapping[str, float]) -> str:
    """List what is not seen, with the largest travel of the tip among the missed injections."""
    lines = []
    for case in CASES:
        keys = ("missed", "blind_missed", "harm_m")
        missed, blind, harm_m = (metrics.get(f"{case_prefix(case)}_{key}") or 0.0 for key in keys)
        if case.blind or missed:
            harm = f"the tip up to {100 * harm_m:.1f} cm astray"
            named = f" ({blind:.0f} of them in a named blind spot)" if missed else ""
            explanation = f" {case.blind}" if case.blind else ""
            lines.append(f"- *{case.number}, {case.title}*: {missed:.0f} missed{named}, {harm}.{explanation}")
    return "\n".join(lines) or "None."


def write_evidence(outcomes: Mapping[str, Mapping[str, Any]], metrics: Mapping[str, float], folder: Path) -> None:
    """Write the evidence page of every entry, and that of the work without faults, into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    by_case = injections_of(outcomes)
    (folder / "work-without-faults.md").write_text(work_page(outcomes.values()))
    for case in CASES:
        (folder / f"{case.label}.md").write_text(evidence(case, by_case.get(case.number, []), metrics))


def work_page(outcomes: Iterable[Mapping[str, Any]]) -> str:
    """Write the page of the work without faults: hours by scene, every stop with what it takes to see it again, the
    missions' logs, and how near each monitor came to a stop.
    """
    work = [o for o in outcomes if "working_s" in o or o.get("scene", "").startswith("mission")]
    done = [o for o in work if "trips" in o]
    by_scene: dict[str, list[Mapping[str, Any]]] = {}
    for outcome in done:
        by_scene.setdefault(outcome["scene"], []).append(outcome)
    out = ["---", "orphan: true", "---", "", "# Work without faults", ""]
    out += ["| scene | stretches | hours | false trips |", "|---|---|---|---|"]
    trips = []
    for scene, stretches in sorted(by_scene.items()):
        stopped = [(o["seed"], at_s, why) for o in stretches for at_s, why in o["trips"]]
        out.append(
            f"| {scene} | {len(stretches)} | {sum(o['seconds'] for o in stretches) / HOUR_S:.2f} | {len(stopped)} |"
        )
        trips += [f"- {scene}, seed {seed}, after {at_s:.2f} s: {why}" for seed, at_s, why in stopped]
    out += ["", *(trips or ["No stretch of work was stopped."]), ""]
    missions = [o for o in work if o["scene"].startswith("mission")]
    if missions:
        out += [
            "## Missions",
            "",
            "| scene | seed | minutes | loaded | in the bunk | end |",
            "|---|---|---|---|---|---|",
        ]
        for o in missions:
            end = "finished" if o.get("finished") else o["failure"]
            out.append(
                f"| {o['scene']} | {o['seed']} | {o['seconds'] / 60.0:.1f} | {o.get('loaded', 0)} "
                f"| {o.get('in_bunk', 0)} | {end} |"
            )
        out.append("")
    return "\n".join(out + separations(done))


def separations(work: Sequence[Mapping[str, Any]]) -> list[str]:
    """Tell how near each monitor came to a stop in work without faults, as lines of Markdown."""
    measured = [o for o in work if "shares" in o]
    if not measured:
        return []
    lines = [
        "## How near work comes to a stop",
        "",
        "A monitor's share is its statistic over its threshold: at 1 it stops or slows the machine. Armed seconds by "
        "their greatest share, of any joint:",
        "",
        "| monitor | hours | above 0.5 [s] | above 0.8 [s] | 1 and above [s] | greatest | where |",
        "|---|---|---|---|---|---|---|",
    ]
    half, most = EDGES.index(0.5) + 1, EDGES.index(0.8) + 1
    for name, one in sorted(merged(measured).items()):
        bins = one["bins"]
        where = f"{one['where']}, {one['run']}" if one["most"] > 0.0 else _EMPTY
        lines.append(
            f"| {name} | {sum(bins) / HOUR_S:.2f} | {sum(bins[half:])} | {sum(bins[most:])} | {bins[-1]} "
            f"| {one['most']:.2f} | {where} |"
        )
    return [*lines, ""]


def evidence(case: Case, rows: Sequence[Mapping[str, Any]], metrics: Mapping[str, float]) -> str:
    """Write one page: what, bound, measured, one example, verdict."""
    p = case_prefix(case)
    verdicts = Counter(o["verdict"] for o in rows)
    kinds = ", ".join(sorted({kind for o in rows for kind in _kinds(o)}))
    missed = [o for o in rows if o["missed"]]
    verdict = (
        "No injection." if not rows else "Missed: none." if not missed else f"Missed: {len(missed)} of {len(rows)}."
    )
    out = [
        "---",
        "orphan: true",
        "---",
        "",
        f"# {case.number}: {case.title}",
        "",
        verdict,
        "",
        f"Promised: {case.reaction}; bound {case.bound}. Injected as: {kinds or 'nothing'}.",
        "",
    ]
    out += [f"Not seen: {case.blind}", ""] if case.blind else []
    out += ["| | |", "|---|---|"]
    for key, title in (
        ("injections", "Injections"),
        ("missed", "Missed"),
        ("blind_missed", "Missed in a named blind spot"),
        ("p50_ms", "Detection, median [ms]"),
        ("p99_ms", "Detection, 99th percentile [ms]"),
        ("max_ms", "Detection, longest [ms]"),
        ("neutral_max_ms", "Valves of the crane's joints and the drive neutral, longest [ms]"),
        ("travel_max_m", "Way of the tip until rest, longest [m]"),
        ("astray_max_m", "Tip astray, largest [m]"),
        ("harm_m", "The same, of missed injections [m]"),
    ):
        out.append(f"| {title} | {_number(metrics.get(f'{p}_{key}'))} |")
    out += ["", "| scene | injections | verdicts |", "|---|---|---|"]
    for scene in sorted({o["scene"] for o in rows}):
        counted = Counter(o["verdict"] for o in rows if o["scene"] == scene)
        out.append(
            f"| {scene} | {sum(counted.values())} | {', '.join(f'{k} {n}' for k, n in sorted(counted.items()))} |"
        )
    example = max(
        missed or rows, key=lambda o: o["detect_ms"] or math.inf if missed else o["detect_ms"] or 0.0, default=None
    )
    if example is not None:
        out += ["", f"## {'A missed injection' if missed else 'The slowest detection'}", "", *_example(example)]
    out += ["", f"Verdicts: {', '.join(f'{k} {n}' for k, n in sorted(verdicts.items())) or 'none'}.", ""]
    return "\n".join(out)


def _example(o: Mapping[str, Any]) -> list[str]:
    detected = f"detected after {o['detect_ms']:.1f} ms" if o["detect_ms"] is not None else "not detected"
    lines = [
        f"Scene `{o['scene']}`, seed `{o['seed']}`, injected {', '.join(f'`{w}`' for w in o['orders'])} at "
        f"{o['at_ms'] / 1e3:.3f} s; expected {o['expected']} within {o['bound_ms']:.0f} ms{_since(o)}; {detected}; "
        f"way of the tip {o['travel_m']:.3f} m; {'at rest' if o['standing'] else 'not at rest'} at the end; "
        f"verdict {o['verdict']}.",
        "",
        "| ms after the fault | |",
        "|---|---|",
    ]
    return lines + [f"| {ms:.1f} | {text} |" for ms, text in o["timeline"]]


def _since(o: Mapping[str, Any]) -> str:
    """Tell from when the bound counts, where that is not the moment of the fault."""
    due_ms = o.get("due_ms", 0.0)
    if due_ms == 0.0:
        return ""
    return " of an overload, which did not come" if due_ms is None else f" of the overload at {due_ms:.1f} ms"


def _kinds(o: Mapping[str, Any]) -> list[str]:
    return [f"`{order_text.split('/')[0].split('=')[0].split('+')[0]}`" for order_text in o["orders"]]


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return _EMPTY
    if math.isinf(value):
        return "never"
    return f"{value:.0f}" if value.is_integer() or value >= 100 else f"{value:.3g}"
