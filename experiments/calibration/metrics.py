"""Metrics of the calibration experiment with their limits, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from experiments.common.result import Metric, rate
from experiments.common.result_page import Section
from experiments.common.worlds import profile_named
from machine.joints import Joint
from machine.profile import joint

SHIPPED: Final = {"palms": "palms_471", "aoro": "aoro_fc8"}
"""Machines of the published page, by the prefix of their metrics."""
TIP_EMPTY_MM, TIP_LOADED_MM = 6.0, 20.0
"""Small compared with the centimetres that the crane may be off in total."""
DEADBAND_PCT, GAIN, DELAY_MS, SECONDS = 1.0, 0.05, 10.0, 240.0
ROT_DEADBAND_PCT, ROT_QUARTER = 2.5, 0.03

_CONCLUSION: Final = (
    "Calibration ends with a plausible profile on {palms_complete} of the PALMS machines and on {aoro_complete} of the "
    "AORO machines.",
    "The largest dead-band error falls from {aoro_deadband_before} to {aoro_deadband_max} on the AORO, and the true "
    "pin is at most {aoro_tip_max} away from where the calibrated profile places it ({aoro_tip_before} before).",
)
INTRODUCTION: Final = (
    "`timberhand calibrate` identifies dead-bands, gains, dead times, encoder zeros and sag of a machine through its "
    "bus and writes them into a profile. This experiment runs it on virtual machines with a hidden ground truth and "
    "compares the profile with that truth. With the `sampled` truth these are machines near their profile; valves of "
    "any kind, about which the profile knows nothing, are tried with `--truth wide_valves`."
)


def machines_of(profile: str) -> dict[str, str]:
    """Name the machines to calibrate by the prefix of their metrics: the shipped ones, or a user's profile."""
    return SHIPPED if profile in SHIPPED.values() else {profile_named(profile).name: profile}


def metrics_in(found: Mapping[str, float]) -> tuple[Metric, ...]:
    """List the metrics that a result has, of every machine in it."""
    return tuple(m for section in sections(found) for m in section.metrics)


def conclusion(found: Mapping[str, float]) -> tuple[str, ...]:
    """Write the conclusion of a result, as templates."""
    if all(f"{short}_complete" in found for short in SHIPPED):
        return _CONCLUSION
    return tuple(
        f"Calibration of {s} ends with a plausible profile in {{{s}_complete}} of the runs; the largest dead-band "
        f"error falls from {{{s}_deadband_before}} to {{{s}_deadband_max}}, and the true pin is at most "
        f"{{{s}_tip_max}} away from where the calibrated profile places it ({{{s}_tip_before}} before)."
        for s in _prefixes(found)
    )


def sections(found: Mapping[str, float]) -> tuple[Section, ...]:
    """Make one section for every machine in a result."""
    return tuple(
        Section(
            _TITLES.get(s, s),
            _TEXT,
            _metrics(s, f"{s}_rot_gain_max" in found),
            ((f"errors_{s}.png", "Errors of every joint and side, all trials."),),
        )
        for s in _prefixes(found)
    )


def _prefixes(found: Mapping[str, float]) -> list[str]:
    """List the machines of a result, the shipped ones in their order."""
    names = [name.removesuffix("_complete") for name in found if name.endswith("_complete")]
    return [*(s for s in SHIPPED if s in names), *(n for n in names if n not in SHIPPED)]


def _metrics(short: str, blind_rotator: bool) -> tuple[Metric, ...]:
    def m(name: str, title: str, unit: str, how: str, **more: Any) -> Metric:
        # The name of a user's machine may hold what looks like a unit.
        more.setdefault("scale", 1.0 if unit == "mm" else None)
        return Metric(f"{short}_{name}", title, unit, how, **more)

    return (
        m(
            "complete",
            "Runs that end with a plausible profile",
            "%",
            "No stop, no refused request, and no value that the calibration itself rejects.",
            least=0.95,
        ),
        m(
            "deadband_max",
            "Dead-band, largest error",
            "% of spool",
            "Middle of the hysteresis against the truth, both sides of every joint with an encoder, all trials.",
            most=DEADBAND_PCT,
        ),
        m("deadband_rms", "Dead-band, RMS error", "% of spool", "The same values."),
        m("deadband_before", "Dead-band of the shipped profile, largest error", "% of spool", "Before calibration."),
        m(
            "gain_max",
            "Full speed, largest error",
            "%",
            "Against the plant's own speed at the same place, measured without bus, controller and sensors.",
            most=GAIN,
        ),
        m("gain_rms", "Full speed, RMS error", "%", "The same values."),
        m("gain_before", "Full speed of the shipped profile, largest error", "%", "Before calibration."),
        m(
            "delay_max",
            "Dead time, largest error",
            "ms",
            "From the command on the bus to the spool, against the truth.",
            most=DELAY_MS,
        ),
        m("delay_before", "Dead time of the shipped profile, largest error", "ms", "Before calibration."),
        m(
            "seconds_max",
            "Longest calibration",
            "s",
            "Simulated time from the first to the last motion, survey included.",
            most=SECONDS,
        ),
        m(
            "pin_before",
            "Surveyed pin against encoders before calibration",
            "mm",
            "Largest distance, all poses and trials.",
        ),
        m(
            "pin_after",
            "Surveyed pin against encoders with zeros and sag",
            "mm",
            "Largest distance; a reading has 2 mm of noise on every axis.",
        ),
        m(
            "tip_before",
            "True pin against encoders before calibration, empty",
            "mm",
            "Largest distance at eight poses that were not surveyed; four are the goals of paper B.",
        ),
        m(
            "tip_max",
            "True pin against the calibrated profile, empty, largest",
            "mm",
            "The same poses; kinematics with the zeros and the sag of the calibrated profile.",
            most=TIP_EMPTY_MM,
        ),
        m("tip_rms", "True pin against the calibrated profile, empty, RMS", "mm", "The same values."),
        m("tip_loaded_before", "True pin against encoders before calibration, with 200 kg", "mm", "Largest distance."),
        m(
            "tip_loaded_max",
            "True pin against the calibrated profile, with 200 kg, largest",
            "mm",
            "The load is known, as from a load cell; the calibration itself has only weighed the empty crane.",
            most=TIP_LOADED_MM,
        ),
        m("tip_loaded_rms", "True pin against the calibrated profile, with 200 kg, RMS", "mm", "The same values."),
        m(
            "give",
            "Compliance of the column, largest error",
            "%",
            "Identified lean per moment over the truth's; it contains what the profile has wrong of the lift cylinder.",
        ),
        m(
            "load_max",
            "Load from the lift's pressures, largest error",
            "kg",
            "Empty and with 200 kg, the boom coming to rest from above or from below; friction is what remains.",
        ),
        m("load_rms", "Load from the lift's pressures, RMS error", "kg", "The same values."),
        m(
            "zero_slew",
            "Encoder zero of the slew, largest error",
            "mrad",
            "Against the truth, without eccentricity.",
            scale=1e3,
        ),
        m("zero_tilt", "Encoder zero of the tilt, largest error", "mrad", "The same for the stick.", scale=1e3),
        m(
            "zero_lift",
            "Encoder zero of the lift, largest error",
            "mrad",
            "The same for the boom; a leaning column looks almost like a boom with a wrong zero.",
            scale=1e3,
        ),
        m("zero_ext", "Encoder zero of the telescope, largest error", "mm", "The same for the telescope.", scale=1e3),
        *(_rotator_metrics(m) if blind_rotator else ()),
    )


def rotator_is_blind(profile: str) -> bool:
    """Tell whether the rotator of the machine has no encoder."""
    return joint(profile_named(profile), Joint.ROT).encoder is None


def _rotator_metrics(m: Callable[..., Metric]) -> tuple[Metric, ...]:
    """Define the metrics of a rotator without an encoder."""
    return (
        m(
            "rot_deadband_max",
            "Rotator without encoder: dead-band, largest error",
            "% of spool",
            "From surveyed turns, fitted with the metering curve of the profile, which differs from the truth's.",
            most=ROT_DEADBAND_PCT,
        ),
        m(
            "rot_deadband_before",
            "Rotator: dead-band of the shipped profile, largest error",
            "% of spool",
            "Before calibration.",
        ),
        m(
            "rot_gain_max",
            "Rotator without encoder: full speed, largest error",
            "%",
            "Against the truth of its valve.",
            most=GAIN,
        ),
        m("rot_gain_before", "Rotator: full speed of the shipped profile, largest error", "%", "Before calibration."),
        m(
            "rot_quarter_max",
            "Rotator without encoder: quarter turn, largest error",
            "%",
            "True angle of the quarter turns that a planner commands, two to either side: the drift of the dead "
            "reckoning.",
            most=ROT_QUARTER,
        ),
        m("rot_quarter_rms", "Rotator: quarter turn, RMS error", "%", "The same values."),
        m(
            "rot_quarter_before",
            "Rotator: quarter turn with the shipped profile, largest error",
            "%",
            "Before calibration.",
        ),
    )


_TITLES: Final = {"palms": "PALMS 4.71", "aoro": "AORO, CRANAB FC8"}
_TEXT: Final = (
    "Every trial uses another individual machine: dead-bands, gains, dead times, zeros, masses, friction and stiffness "
    "are drawn anew (`sim/truth`). Calibration knows the shipped profile, the bus and a surveying "
    "instrument with 2 mm of noise."
)


def metrics_of(short: str, profile: str, outcomes: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Compute the metrics of all trials of one kind of machine; their names begin with ``short``."""
    ended = [o for o in outcomes if not o["failure"]]
    good = [o for o in ended if not o["implausible"]]
    joints = [r for o in ended for r in o["joints"].values()]
    values = {
        "deadband_max": _largest(x for r in joints for x in r["deadband_pct"]),
        "deadband_rms": _rms(x for r in joints for x in r["deadband_pct"]),
        "deadband_before": _largest(x for r in joints for x in r["profile"]["deadband_pct"]),
        "gain_max": _largest(x for r in joints for x in r["gain"]),
        "gain_rms": _rms(x for r in joints for x in r["gain"]),
        "gain_before": _largest(x for r in joints for x in r["profile"]["gain"]),
        "delay_max": _largest(r["delay_ms"] for r in joints),
        "delay_before": _largest(x for r in joints for x in r["profile"]["delay_ms"]),
        "seconds_max": _largest(o["seconds"] for o in outcomes),
        "pin_before": _largest(x for o in ended for x in o.get("before_mm", ())),
        "pin_after": _largest(x for o in ended for x in o.get("after_mm", ())),
    }
    tips = [o["tip"] for o in good]
    for name, key in (("tip", "empty"), ("tip_loaded", "loaded"), ("load", "load_kg")):
        values[f"{name}_max"] = _largest(x for t in tips for x in t[key])
        values[f"{name}_rms"] = _rms(x for t in tips for x in t[key])
    values["tip_before"] = _largest(x for t in tips for x in t["before"])
    values["tip_loaded_before"] = _largest(x for t in tips for x in t["loaded_before"])
    values["give"] = _largest(o["give"] for o in ended if "give" in o)
    values |= {
        f"zero_{n}": _largest(o["zeros"][n] for o in ended if "zeros" in o) for n in ("slew", "lift", "tilt", "ext")
    }
    if rotator_is_blind(profile):
        blind = [o["rotator"] for o in good if "rotator" in o]
        for name, key in (("deadband", "deadband_pct"), ("gain", "gain"), ("quarter", "quarter")):
            values[f"rot_{name}_max"] = _largest(x for r in blind for x in r[key])
            values[f"rot_{name}_before"] = _largest(x for r in blind for x in r["profile"][key])
        values["rot_quarter_rms"] = _rms(x for r in blind for x in r["quarter"])
    return {
        **{f"{short}_{name}": value for name, value in values.items()},
        **rate(f"{short}_complete", len(good), len(outcomes)),
    }


def _largest(values: Iterable[float]) -> float:
    return max((abs(x) for x in values), default=math.nan)


def _rms(values: Iterable[float]) -> float:
    squares = [x * x for x in values]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan
