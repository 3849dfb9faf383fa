"""The report of a calibration: result.json and a page of plots per joint, for the person who decides.

Everything comes from the `CalibrationResult`; the same result gives the same files.
"""

from __future__ import annotations

import json
from math import isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np

from autonomy.calibration.profile_file import Change, lowered_gains
from autonomy.calibration.result import CalibrationResult, JointResult
from autonomy.calibration.survey import OFFSETS
from autonomy.calibration.turn_fit import TurnFit
from machine.joints import Joint

DECIMALS: Final = 6
SMALL_BELOW, SMALL_DECIMALS = 1e-3, 12


def result_document(result: CalibrationResult, facts: dict[str, Any], changed: list[Change]) -> dict[str, Any]:
    """Return the whole result as plain data."""
    joints = {j.name.lower(): _joint(r) for j, r in result.joints.items()}
    survey = None
    if (s := result.survey) is not None:
        survey = {
            "offsets": {j.name.lower(): o for j, o in zip(OFFSETS, s.offsets, strict=True)},
            "offset_errors": {j.name.lower(): e for j, e in zip(OFFSETS, s.errors, strict=True)},
            "sag": {name: getattr(s.sag, name) for name in s.sag.__struct_fields__},
            "moments_left_nm": list(s.moments_nm),
            "before_mm": [1e3 * d for d in s.before_m],
            "after_mm": [1e3 * d for d in s.after_m],
        }
    document: dict[str, Any] = _rounded(
        {
            **facts,
            "plausible": not result.implausible,
            "implausible": [problem.sentence for problem in result.implausible],
            "joints": joints,
            "grapple_s": {c.name.lower(): t for c, t in result.grapple_s.items()},
            "survey": survey,
            **({} if result.turns is None else {"rotator": _rotator(result.turns)}),
            **({"kept": list(result.kept)} if result.kept else {}),
            **({"lowered": lowered} if (lowered := lowered_gains(changed)) else {}),
            "changes": {".".join(path): value for path, value, _ in changed},
        }
    )
    return document


def _joint(r: JointResult) -> dict[str, Any]:
    v, d = r.valve, r.delay
    return {
        "deadband_pct": [100.0 * x for x in v.deadbands],
        "hysteresis_pct": 100.0 * v.hysteresis,
        "full_speed": list(v.full_speeds),
        "at": v.at,
        "exponent": v.exponent,
        "lever_1_rad": v.lever,
        "ringing_rad_s": v.ringing[0],
        "delay_s": None if d is None else d.delay_s,
        "spool_lag_s": None if d is None else d.lag_s,
        "response_s": list(r.responses_s),
        "repeat_pct": [100.0 * x for x in r.repeats],
        "fastest": r.fastest,
        "residual": v.residual,
        "errors": v.errors,
    }


def _rotator(turns: TurnFit) -> dict[str, Any]:
    sides = (turns.plus, turns.minus)
    return {
        "deadband_pct": [100.0 * s.deadband for s in sides],
        "deadband_errors_pct": [100.0 * s.errors[0] for s in sides],
        "full_speed": [s.full_speed for s in sides],
        "full_speed_errors": [s.errors[1] for s in sides],
        "turns_rad": [list(s.turns_rad) for s in sides],
        "left_rad": [list(s.left_rad) for s in sides],
    }


def _rounded(value: Any) -> Any:
    """Round numbers to six decimals, small ones to twelve, to hide last bits; non-finite numbers become null."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    if isinstance(value, float):
        if not isfinite(value):
            return None
        return round(value, DECIMALS if abs(value) >= SMALL_BELOW else SMALL_DECIMALS)
    return value


def write_report(folder: Path, result: CalibrationResult, facts: dict[str, Any], changed: list[Change]) -> None:
    """Write ``result.json``, ``JOINT.png`` for every joint and ``survey.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").write_text(json.dumps(result_document(result, facts, changed), indent=2) + "\n")
    for j, r in result.joints.items():
        _draw_joint(folder / f"{j.name.lower()}.png", r)
    if result.survey is not None:
        _draw_survey(folder / "survey.png", result)


def _figure(columns: int) -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(1, columns, figsize=(4.2 * columns, 3.4), layout="constrained")


def _save(figure: Any, path: Path) -> None:
    from matplotlib import pyplot

    figure.savefig(path, dpi=100, metadata={"Software": None})
    pyplot.close(figure)


def _draw_joint(path: Path, r: JointResult) -> None:
    """Draw speed over spool with the fitted curve; sweeps (dead-band and hysteresis); staircases; spool after its
    command.
    """
    unit = "m" if r.joint is Joint.EXT else "rad"
    figure, (curve, sweep, stairs, delay) = _figure(4)
    for test, modelled in zip(r.tests, r.valve.modelled, strict=True):
        step = test.time_s[1] - test.time_s[0]
        spool = 100.0 * (test.command if test.spool is None else test.spool)
        wide = 16
        speed = (test.position[wide:] - test.position[:-wide]) / (wide * step)
        if test.kind == "sweep":
            sweep.plot(test.time_s, test.side * (test.position - test.position[0]), lw=1.2)
            sweep.plot(test.time_s, test.side * (modelled - modelled[0]), "k--", lw=0.8)
            curve.plot(spool[wide // 2 : -wide // 2], speed, lw=0.6, alpha=0.6)
        else:
            stairs.plot(test.time_s, test.position, lw=1.2)
            stairs.plot(test.time_s, modelled, "k--", lw=0.8)
            curve.plot(spool[wide // 2 : -wide // 2], speed, ".", ms=1.0, alpha=0.4)
            delay.plot(test.time_s, 100.0 * test.side * test.command, "k", lw=0.6)
            delay.plot(test.time_s, test.side * spool, lw=1.0)
    v = r.valve
    for side, i in ((1, 0), (-1, 1)):
        x = np.linspace(0.0, 1.0, 201)
        opening = np.clip((x - v.deadbands[i]) / (1.0 - v.deadbands[i]), 0.0, 1.0)
        curve.plot(100.0 * side * x, side * v.full_speeds[i] * opening**v.exponent, "k", lw=0.9)
    name = r.joint.name.lower()
    curve.set(title=f"{name}: speed over spool", xlabel="spool [%]", ylabel=f"{unit}/s")
    sweep.set(title="sweeps: out of the dead-band, back", xlabel="s", ylabel=f"way [{unit}], dashed: fit")
    stairs.set(title="staircases, dashed: fit", xlabel="s", ylabel=unit)
    late = "" if r.delay is None else f": {1e3 * r.delay.delay_s:.0f} ms dead, {1e3 * r.delay.lag_s:.0f} ms lag"
    delay.set(title=f"spool{late}", xlabel="s", ylabel="%")
    for axis in (curve, sweep, stairs, delay):
        axis.grid(alpha=0.3)
    _save(figure, path)


def _draw_survey(path: Path, result: CalibrationResult) -> None:
    """Draw the distance between surveyed and computed pin at every pose, before and after the fit."""
    s = result.survey
    assert s is not None
    figure, axis = _figure(1)
    at = np.arange(len(s.before_m))
    axis.bar(at - 0.2, [1e3 * d for d in s.before_m], 0.4, label="as shipped")
    axis.bar(at + 0.2, [1e3 * d for d in s.after_m], 0.4, label="with zeros and sag")
    axis.set(title="surveyed pin against computed pin", xlabel="pose", ylabel="mm")
    axis.legend(frameon=False)
    _save(figure, path)
