"""The soak: the controller at its rate for half an hour, and nothing may grow and no frame may be lost."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from can_dbc.timing.page import Facts
from experiments.common.plot_style import OIL, STEEL, TIMBER, sheet
from experiments.common.registry import Options
from experiments.common.result import Figure, Result, commit, environment
from experiments.common.result_page import Section, tell
from experiments.timing import evaluation, host_activity
from experiments.timing.evaluation import STEADY_TICKS
from experiments.timing.measurement import between
from experiments.timing.plots import exceeded
from experiments.timing.testbed import Setting, Stand
from machine.load import load_profile
from machine.reasons import Reason

MINUTES: Final = 30.0
QUICK_MINUTES: Final = 1.0 / 3.0
WARM_S: Final = 5.0
EVERY_S: Final = 5.0
READINGS: Final = 20
"""At least; a short run reads more often."""
MOVING: Final = 0.5
TOO_LATE: Final = frozenset({
    Reason.ESTOP_LOST, Reason.GUARD_LOST, Reason.GUARD_REFUSES, Reason.ENCODER_LOST, Reason.VALVE_FEEDBACK_LOST,
    Reason.PRESSURE_LOST, Reason.CARRIER_LOST, Reason.SWING_ARMS_LOST, Reason.GNSS_LOST, Reason.ENGINE_LOST,
    Reason.SAFETY_NODE_LOST, Reason.ENCODER_NODE_LOST, Reason.PRESSURE_NODE_LOST, Reason.LOOP_LATE,
    Reason.LOOP_STALLED, Reason.LEASE_LOST,
})  # fmt: skip
"""Stops for something that came too late; where no frame is lost, one of the processes was not let run."""
LOSSES: Final = ("gaps", "gaps_rig", "unanswered", "frames_lost", "records_lost")
FLAT_KB: Final = 64.0
"""Memory that may come and go: resident memory is counted in pages, some of them shared."""

BREATH_BLOCKS: Final = 8.0
"""So many blocks come and go with the moment of the reading; a leak of one a second is more even in a short run."""
STOP_BLOCKS: Final = 40.0
"""So many may stay after a stop and the arming that follows it (25 measured; a second stop adds none)."""

MEMORY: Final = Section(
    "Memory",
    "Read every few seconds; the greatest of the second half less the greatest of the first. Memory breathes, so the "
    "blocks of the interpreter are compared by their least.",
    (
        Figure("controller_growth_kb", "Controller's resident memory grows by", "kB", "getrusage and /proc/PID/status.",
               most=FLAT_KB),
        Figure("guard_growth_kb", "Guard's resident memory grows by", "kB", "VmRSS of /proc/PID/status.", most=FLAT_KB),
        Figure("allocated_blocks_growth", "Blocks that stay in the controller", "",
               "sys.getallocatedblocks, by the timing page.", most=0.0),
        Figure("gc_runs", "Runs of the garbage collector", "", "In the controller.", most=0.0),
        Figure("major_faults", "Page faults that go to the disk", "", "In the controller.", most=0.0),
    ),
    (("memory.png", "Resident memory of controller and guard, and the controller's blocks, over the run."),),
)  # fmt: skip
FRAMES: Final = Section(
    "Frames",
    "A witness reads the controller's record of every tick: all frames it received and sent, in order. Protected "
    "frames carry a counter and a CRC; a counter that does not follow the one before is a lost frame. Encoders carry "
    "none: they must answer every SYNC. The rig checks what it receives in the same way.",
    (
        Figure("minutes", "Length", "min", "After a few seconds of warming up."),
        Figure("received", "Frames received by the controller", "", "All buses."),
        Figure("sent", "Frames sent by it", "", "All buses."),
        Figure("gaps", "Gaps in its protected frames, in and out", "", "By the witness.", most=0.0),
        Figure("gaps_rig", "Gaps in what the rig received", "", "By the rig.", most=0.0),
        Figure("damaged", "Frames with a wrong CRC", "", "Both.", most=0.0),
        Figure("unanswered", "SYNCs that an encoder left without an answer", "", "By the witness.", most=0.0),
        Figure("frames_lost", "Frames refused by a bus or lost before they were read", "", "Controller and rig.",
               most=0.0),
        Figure("records_lost", "Tick records that are missing", "", "By their nominal times.", most=0.0),
    ),
)  # fmt: skip
TIMES: Final = Section(
    "Time",
    "The histogram of the whole run. In user-mode Linux a system call costs a hundred times the host's, so these "
    "numbers say that the machine lived with them, not what the controller costs.",
    (
        Figure("ticks", "Ticks", "", "That ran."),
        Figure("missed", "Periods missed", "", "Skipped whole."),
        Figure("stops", "Stops of the machine", "", "The planner's stand-in armed it again after each."),
        Figure("active_share", "Share of the readings in which the machine moved", "%",
               "Mode ACTIVE; a host that stalls any of the processes stops the machine, as it should.",
               least=MOVING, scale=100.0),
        Figure("wakeup_p50_us", "Lateness, median", "us", "Of all ticks."),
        Figure("wakeup_p99_us", "Lateness, p99", "us", "Of all ticks."),
        Figure("wakeup_max_us", "Longest lateness", "us", "Of all ticks."),
        Figure("tick_cpu_p99_us", "Processor time of a tick, p99", "us", "Of all ticks."),
        Figure("steal_ms", "Time the hypervisor took", "ms", "/proc/stat."),
    ),
    (("lateness.png", "Share of wake-ups that were later than x."),),
)  # fmt: skip
SECTIONS: Final = (FRAMES, MEMORY, TIMES)
FIGURES: Final = tuple(f for section in SECTIONS for f in section.figures)


@dataclass(frozen=True, slots=True)
class Reading:
    """One look: seconds since the start, the controller's facts, resident memory of both [kB], mode."""

    at_s: float
    facts: Facts
    controller_kb: int
    guard_kb: int
    mode: str


def run(options: Options, console: Console) -> Result:
    """Soak; writes ``options.out`` and, when asked, the docs."""
    minutes = options.minutes or (QUICK_MINUTES if options.quick else MINUTES)
    profile = load_profile(options.profile)
    setting = Setting(options.profile, profile.rate_hz, options.bus)
    console.print(f"soak: {minutes:.3g} minutes, {profile.name} at {profile.rate_hz} Hz on {options.bus}")
    first = host_activity.sample()
    with console.status("soak: starting") as status, Stand(setting, options.out / "stand") as stand:
        stand.wait(WARM_S)
        begin = stand.fresh_timing()
        before = copied(stand.said)
        began, readings = time.monotonic(), list[Reading]()
        while (passed := time.monotonic() - began) < 60.0 * minutes:
            readings.append(read(stand, passed))
            status.update(f"soak: {passed / 60:.1f} of {minutes:.3g} min, {readings[-1].facts.words}")
            stand.wait(min(EVERY_S, 60.0 * minutes / READINGS, 60.0 * minutes - passed))
        end = stand.fresh_timing()
        readings.append(read(stand, time.monotonic() - began))
        after, stops, modes, halts = copied(stand.said), stand.stops, list(stand.modes), set(stand.halts)
    durations = between(begin, end)
    metrics = {
        "minutes": minutes,
        "ticks": float(end.facts.ticks - begin.facts.ticks),
        "missed": float(end.facts.missed - begin.facts.missed),
        "stops": float(stops),
        "active_share": sum(r.mode == "ACTIVE" for r in readings) / len(readings),
        "steal_ms": host_activity.between(first, host_activity.sample()).steal_ms,
        **memory(readings),
        **frames(before, after, begin.facts, end.facts),
        **evaluation.spread_us("wakeup", durations["wake"]),
        **evaluation.spread_us("tick_cpu", durations["cpu"]),
    }
    found = evaluation.judge(FIGURES, metrics, untold(metrics, halts))
    result = Result(
        experiment="soak",
        commit=commit(),
        profile=profile.name,
        seed=options.seed,
        trials=1,
        metrics=metrics,
        paper={},
        environment={**environment(), **host_activity.describe(), "bus": options.bus, "lab": lab(), "modes": "; ".join(modes)},
        limits={f.name: (f.least, f.most) for f in FIGURES if f.limit_text()},
        missed=found.missed,
        inconclusive=tuple(found.inconclusive),
    )
    options.out.mkdir(parents=True, exist_ok=True)
    draw_memory(readings, options.out / "memory.png")
    with sheet(options.out / "lateness.png") as axis:
        axis.step(*exceeded(durations["wake"]), where="post", color=OIL)
        axis.axvline(setting.period_ns / 1e3, color=STEEL, ls="--", lw=0.8)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("lateness [us]")
        axis.set_ylabel("share of wake-ups that are later")
    e = result.environment
    words = (
        f"Commit `{result.commit}`, `{profile.name}` at {profile.rate_hz} Hz on {options.bus}{e['lab']}. Host: "
        f"{e['processor']}, {e['cpus']} cores, kernel {e['kernel']}, Python {e['python']}."
    )
    tell(result, "Soak", INTRODUCTION, SECTIONS, options, console, words)
    return result


INTRODUCTION: Final = (
    "The real controller and guard drive the timing stand without a pause: nothing may grow, and no frame may be lost. "
    "`make soak` measures it and fails when one of the limits is missed; no number is typed."
)


def untold(metrics: dict[str, float], halts: set[Reason]) -> dict[str, str]:
    """What this run cannot tell, with the reason.

    ``halts``: why the machine stopped.  Inputs that are late though none is lost are the host's doing only.
    """
    found = {}
    late = bool(halts) and halts <= TOO_LATE and not any(metrics[name] for name in LOSSES)
    if metrics["active_share"] < MOVING and late:
        found["active_share"] = "the host did not let the processes run in time: inputs came late, none was lost"
    most = STOP_BLOCKS if halts else BREATH_BLOCKS
    if metrics["ticks"] < STEADY_TICKS and 0.0 < metrics["allocated_blocks_growth"] <= most:
        found["allocated_blocks_growth"] = f"{metrics['ticks']:.0f} ticks are too few to tell a leak from a breath"
    return found


def lab() -> str:
    """Words for the kernel in which the soak ran."""
    return " in user-mode Linux" if os.environ.get("TIMBERHAND_LAB") == "uml" else ""


def read(stand: Stand, at_s: float) -> Reading:
    """One look at a running stand."""
    pids = {name: child.process.pid for name, child in stand.family.children.items()}
    return Reading(
        at_s, stand.timing().facts, resident_kb(pids["controller"]), resident_kb(pids["guard"]), stand.mode
    )  # fmt: skip


def resident_kb(pid: int) -> int:
    """VmRSS of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def memory(readings: Sequence[Reading]) -> dict[str, float]:
    """What has grown between the halves of a run, and what the controller's process counted."""
    half = max(1, len(readings) // 2)
    early, late = readings[:half], readings[half:]
    first, last = readings[0].facts.process, readings[-1].facts.process
    blocks = [r.facts.process.allocated_blocks for r in readings]
    return {
        "controller_growth_kb": float(max(r.controller_kb for r in late) - max(r.controller_kb for r in early)),
        "guard_growth_kb": float(max(r.guard_kb for r in late) - max(r.guard_kb for r in early)),
        "allocated_blocks_growth": float(min(blocks[half:]) - min(blocks[:half])),
        "gc_runs": float(last.gc_runs - first.gc_runs),
        "minor_faults": float(last.minor_faults - first.minor_faults),
        "major_faults": float(last.major_faults - first.major_faults),
    }


def copied(said: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """What the processes have said until now."""
    return {name: dict(words) for name, words in said.items()}


def frames(
    before: dict[str, dict[str, Any]], after: dict[str, dict[str, Any]], begin: Facts, end: Facts
) -> dict[str, float]:
    """What witness, rig and the controller's own counters say of the time between; a rig that is alone on its bus at
    the start is refused frames, so totals mean nothing.
    """

    def grown(who: str, *names: str) -> float:
        return float(sum(after[who][name] - before[who][name] for name in names))

    lost = sum(b.dropped + b.refused for b in end.buses) - sum(b.dropped + b.refused for b in begin.buses)
    return {
        "received": grown("witness", "received"),
        "sent": grown("witness", "sent"),
        "gaps": grown("witness", "gaps"),
        "gaps_rig": grown("rig", "gaps"),
        "damaged": grown("witness", "damaged") + grown("rig", "damaged"),
        "unanswered": grown("witness", "unanswered"),
        "records_lost": grown("witness", "records_lost", "records_unreadable"),
        "frames_lost": lost + grown("rig", "dropped_frames", "refused_frames"),
        "rig_stalls": grown("rig", "stalls"),
    }


def draw_memory(readings: Sequence[Reading], path: Path) -> None:
    """Growth since the first reading."""
    minutes = [r.at_s / 60 for r in readings]
    with sheet(path, 2) as axes:
        for name, colour in (("controller_kb", OIL), ("guard_kb", TIMBER)):
            values = [getattr(r, name) for r in readings]
            axes[0].plot(minutes, [v - values[0] for v in values], color=colour, label=name.removesuffix("_kb"))
        axes[0].set_ylabel("resident memory since the start [kB]")
        axes[0].legend()
        blocks = [r.facts.process.allocated_blocks for r in readings]
        axes[1].plot(minutes, [b - blocks[0] for b in blocks], color=OIL)
        axes[1].set_ylabel("blocks of the controller since the start")
        for axis in axes:
            axis.set_xlabel("min")
