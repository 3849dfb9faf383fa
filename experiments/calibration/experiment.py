"""The calibration experiment: many individual machines of both kinds, calibrated and compared with their truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from rich.console import Console

from experiments.calibration.trial import calibrated
from experiments.common import pool
from experiments.common.plot_style import MOSS, OIL, STEEL, limit_band, sheet
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.common.result import Figure, Result, judged, rate
from experiments.common.result_page import Section, tell
from experiments.common.trials import checkpoint, individuals
from experiments.common.worlds import profile_named
from machine.joints import Joint
from machine.profile import joint

MACHINES: Final = {"palms": "palms_471", "aoro": "aoro_fc8"}
TRIALS: Final = 20
QUICK_TRIALS: Final = 1
FIRST_SEED: Final = 1000
"""Judged on machines that nobody looked at while the procedure was made."""
SEEDS_PER_RUN: Final = 1000
TIP_EMPTY_MM, TIP_LOADED_MM = 6.0, 20.0
"""Small beside the centimetres that the crane may be off by all told."""
DEADBAND_PCT, GAIN, DELAY_MS, SECONDS = 1.0, 0.05, 10.0, 240.0
ROT_DEADBAND_PCT, ROT_QUARTER = 2.5, 0.03
SOURCES: Final = ("autonomy", "controller", "hil/harness/lockstep.py", "hil/calibration/crane.py")


def _figures(short: str) -> tuple[Figure, ...]:
    def f(name: str, *rest: Any, **limits: Any) -> Figure:
        return Figure(f"{short}_{name}", *rest, **limits)

    return (
        f("complete", "Runs that end with a plausible profile", "%",
          "No stop, no refusal, no value that the calibration itself doubts.", least=0.95, scale=100.0),
        f("deadband_max", "Dead-band, greatest error", "% of spool",
          "Middle of the hysteresis against the truth, both sides of every joint with an encoder, all trials.",
          most=DEADBAND_PCT),
        f("deadband_rms", "Dead-band, root mean square error", "% of spool", "The same values."),
        f("deadband_before", "Dead-band of the shipped profile, greatest error", "% of spool",
          "What was there before."),
        f("gain_max", "Full speed, greatest error", "%",
          "Against the plant's own speed past the same place, measured without bus, controller and sensors.",
          most=GAIN, scale=100.0),
        f("gain_rms", "Full speed, root mean square error", "%", "The same values.", scale=100.0),
        f("gain_before", "Full speed of the shipped profile, greatest error", "%", "What was there before.",
          scale=100.0),
        f("delay_max", "Dead time, greatest error", "ms", "Command on the bus to spool, against the truth.",
          most=DELAY_MS),
        f("delay_before", "Dead time of the shipped profile, greatest error", "ms", "What was there before."),
        f("seconds_max", "Longest calibration", "s",
          "Simulated time from the first to the last motion, survey included.", most=SECONDS),
        f("pin_before", "Surveyed pin against encoders, before", "mm", "Greatest distance, all poses and trials."),
        f("pin_after", "Surveyed pin against encoders, with zeros and sag", "mm",
          "Greatest distance; a reading has 2 mm of noise on every axis."),
        f("tip_before", "True pin against encoders, before, empty", "mm",
          "Greatest distance at eight poses that no survey has seen; four are the goals of paper B."),
        f("tip_max", "True pin against the calibrated profile, empty, greatest", "mm",
          "The same poses, zeros and sag of the calibrated profile in the kinematics.", most=TIP_EMPTY_MM),
        f("tip_rms", "True pin against the calibrated profile, empty, root mean square", "mm", "The same values."),
        f("tip_loaded_before", "True pin against encoders, before, with 200 kg", "mm", "Greatest distance."),
        f("tip_loaded_max", "True pin against the calibrated profile, with 200 kg, greatest", "mm",
          "The load is known, as a load cell tells it; calibration has only weighed the empty crane.",
          most=TIP_LOADED_MM),
        f("tip_loaded_rms", "True pin against the calibrated profile, with 200 kg, root mean square", "mm",
          "The same values."),
        f("give", "Give of the column under a load, greatest error", "%",
          "Found lean per moment over the truth's; what the profile has wrong of the lift's cylinder is in it.",
          scale=100.0),
        f("load_max", "Load by the lift's pressures, greatest error", "kg",
          "Empty and with 200 kg, the boom coming to rest from above or from below: friction is what is left."),
        f("load_rms", "Load by the lift's pressures, root mean square error", "kg", "The same values."),
        f("zero_slew", "Zero of the slew, greatest error", "mrad", "Against the truth; eccentricity is not in it.",
          scale=1e3),
        f("zero_tilt", "Zero of the tilt, greatest error", "mrad", "The same for the stick.", scale=1e3),
        f("zero_lift", "Zero of the lift, greatest error", "mrad",
          "The same for the boom; a column that leans looks nearly like a boom that is off.", scale=1e3),
        f("zero_ext", "Zero of the telescope, greatest error", "mm", "The same for the telescope.", scale=1e3),
        *(_rotator_figures(f) if _blind(short) else ()),
    )  # fmt: skip


def _blind(short: str) -> bool:
    """Whether the machine's rotator has no encoder."""
    return joint(profile_named(MACHINES[short]), Joint.ROT).encoder is None


def _rotator_figures(f: Callable[..., Figure]) -> tuple[Figure, ...]:
    """Of a rotator without an encoder."""
    return (
        f("rot_deadband_max", "Rotator without encoder: dead-band, greatest error", "% of spool",
          "By surveyed turns; they are fitted with the profile's metering curve, which is another than the truth's.",
          most=ROT_DEADBAND_PCT),
        f("rot_deadband_before", "Rotator: dead-band of the shipped profile, greatest error", "% of spool",
          "What was there before."),
        f("rot_gain_max", "Rotator without encoder: full speed, greatest error", "%",
          "Against the truth of its valve.", most=GAIN, scale=100.0),
        f("rot_gain_before", "Rotator: full speed of the shipped profile, greatest error", "%",
          "What was there before.", scale=100.0),
        f("rot_quarter_max", "Rotator without encoder: quarter turn, greatest error", "%",
          "True way of the quarter turns that a planner commands, two to either side; so fast drifts the count.",
          most=ROT_QUARTER, scale=100.0),
        f("rot_quarter_rms", "Rotator: quarter turn, root mean square error", "%", "The same values.", scale=100.0),
        f("rot_quarter_before", "Rotator: quarter turn with the shipped profile, greatest error", "%",
          "What was there before.", scale=100.0),
    )  # fmt: skip


_TITLES: Final = {"palms": "PALMS 4.71", "aoro": "AORO, CRANAB FC8"}
_TEXT: Final = (
    "Every trial is another individual: dead-bands, gains, delays, zeros, masses, friction and steel are drawn anew "
    "(`sim/truth`, the sampled spread). Calibration knows the shipped profile, the bus and a surveying instrument with "
    "2 mm of noise."
)
SECTIONS: Final = tuple(
    Section(_TITLES[m], _TEXT, _figures(m), ((f"errors_{m}.png", "Errors of every joint and side, all trials."),))
    for m in MACHINES
)
FIGURES: Final = tuple(f for section in SECTIONS for f in section.figures)
INTRODUCTION: Final = (
    "`timberhand calibrate` finds dead-bands, gains, delays, zeros and sag of a machine through its bus and writes "
    "them into a profile. Here it is run on virtual machines whose truth it cannot see, and compared with that truth. "
    "`timberhand experiment calibration --docs docs` measures everything and writes this page; no number is typed."
)


def run(options: Options, console: Console) -> Result:
    """Calibrate every machine; writes ``options.out`` and, when asked, the docs."""
    trials = options.trials or (QUICK_TRIALS if options.quick else TRIALS)
    truth = individuals(options.truth)
    first = FIRST_SEED + SEEDS_PER_RUN * options.seed
    jobs = [
        Job(f"{short}/{i}", "calibration", first + i, {"profile": name, "truth": truth})
        for i in range(trials)
        for short, name in MACHINES.items()
    ]
    with checkpoint(options, jobs, MACHINES.values(), truth, SOURCES) as kept:
        outcomes = pool.run(calibrated, jobs, kept, options.workers, "calibrations", console)
        by_machine = {m: [o for n, o in outcomes.items() if n.startswith(f"{m}/")] for m in MACHINES}
        metrics: dict[str, float] = {}
        for short, found in by_machine.items():
            metrics |= gather(short, found)
            draw(options.out / f"errors_{short}.png", found)
        result = judged(
            "calibration", FIGURES, metrics, profile=" and ".join(MACHINES.values()), seed=options.seed,
            trials=trials, more={"truth": truth},
        )  # fmt: skip
        for short, found in by_machine.items():
            for outcome in found:
                if outcome["failure"] or outcome.get("implausible"):
                    why = outcome["failure"] or "; ".join(outcome["implausible"])
                    console.print(f"{MACHINES[short]} seed {outcome['seed']}: {why}", highlight=False)
        tell(result, "Calibration, measured", INTRODUCTION, SECTIONS, options, console)
    return result


def gather(short: str, outcomes: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The metrics of one machine's trials."""
    ended = [o for o in outcomes if not o["failure"]]
    good = [o for o in ended if not o["implausible"]]
    joints = [r for o in ended for r in o["joints"].values()]
    values = {
        "deadband_max": _most(x for r in joints for x in r["deadband_pct"]),
        "deadband_rms": _rms(x for r in joints for x in r["deadband_pct"]),
        "deadband_before": _most(x for r in joints for x in r["profile"]["deadband_pct"]),
        "gain_max": _most(x for r in joints for x in r["gain"]),
        "gain_rms": _rms(x for r in joints for x in r["gain"]),
        "gain_before": _most(x for r in joints for x in r["profile"]["gain"]),
        "delay_max": _most(r["delay_ms"] for r in joints),
        "delay_before": _most(x for r in joints for x in r["profile"]["delay_ms"]),
        "seconds_max": _most(o["seconds"] for o in outcomes),
        "pin_before": _most(x for o in ended for x in o.get("before_mm", ())),
        "pin_after": _most(x for o in ended for x in o.get("after_mm", ())),
    }
    tips = [o["tip"] for o in good]
    for name, key in (("tip", "empty"), ("tip_loaded", "loaded"), ("load", "load_kg")):
        values[f"{name}_max"] = _most(x for t in tips for x in t[key])
        values[f"{name}_rms"] = _rms(x for t in tips for x in t[key])
    values["tip_before"] = _most(x for t in tips for x in t["before"])
    values["tip_loaded_before"] = _most(x for t in tips for x in t["loaded_before"])
    values["give"] = _most(o["give"] for o in ended if "give" in o)
    values |= {
        f"zero_{n}": _most(o["zeros"][n] for o in ended if "zeros" in o) for n in ("slew", "lift", "tilt", "ext")
    }
    if _blind(short):
        blind = [o["rotator"] for o in good if "rotator" in o]
        for name, key in (("deadband", "deadband_pct"), ("gain", "gain"), ("quarter", "quarter")):
            values[f"rot_{name}_max"] = _most(x for r in blind for x in r[key])
            values[f"rot_{name}_before"] = _most(x for r in blind for x in r["profile"][key])
        values["rot_quarter_rms"] = _rms(x for r in blind for x in r["quarter"])
    return {
        **{f"{short}_{name}": value for name, value in values.items()},
        **rate(f"{short}_complete", len(good), len(outcomes)),
    }


def _most(values: Any) -> float:
    return max((abs(x) for x in values), default=math.nan)


def _rms(values: Any) -> float:
    squares = [x * x for x in values]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan


def draw(path: Any, outcomes: Sequence[dict[str, Any]]) -> None:
    """Errors per joint: dead-band, gain, dead time."""
    ended = [o for o in outcomes if not o["failure"]]
    names = list(dict.fromkeys(n for o in ended for n in o["joints"]))
    with sheet(path, 3, 9.0, 3.0) as (deadband, gain, delay):
        for x, name in enumerate(names):
            found = [o["joints"][name] for o in ended]
            for axis, values in (
                (deadband, [r["deadband_pct"] for r in found]),
                (gain, [[100.0 * e for e in r["gain"]] for r in found]),
                (delay, [[r["delay_ms"]] for r in found]),
            ):
                for i, color in ((0, OIL), (-1, MOSS)):
                    axis.plot(
                        [x + 0.12 * (1 if i else -1)] * len(values), [v[i] for v in values], ".", ms=4, color=color
                    )
        for axis, title, bound in (
            (deadband, "dead-band error [% of spool]", DEADBAND_PCT),
            (gain, "full speed error [%]", 100.0 * GAIN),
            (delay, "dead time error [ms]", DELAY_MS),
        ):
            axis.set(title=title, xticks=range(len(names)), xticklabels=names, ylim=(-1.4 * bound, 1.4 * bound))
            limit_band(axis, -bound, bound)
            axis.axhline(0.0, color=STEEL, lw=0.6)
