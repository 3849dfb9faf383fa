"""The calibrated profile: a copy of the file with its comments kept and every changed value marked [cal].

The shipped file stays untouched and an existing file is never overwritten.  The copy is loaded and checked before it
gets its name, so no invalid profile is left behind.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.items import Item

from autonomy.calibration.loop_gain import borne_gain_1_s
from autonomy.calibration.result import CalibrationResult, JointResult
from autonomy.calibration.survey import OFFSETS, SurveyFit
from autonomy.calibration.turn_fit import TurnFit
from can_dbc.messages.crane import GrappleCommand
from machine.joints import Joint
from machine.loading.profile_file import ProfileError, load_profile
from machine.profile import JointSpec, Profile, joint
from machine.sensing import lever_share
from runtime.errors import InputRefused

SPEED_LIMIT_SHARE: Final = 0.9
"""A joint that cannot reach its speed limit gets a limit at this share of what it reaches."""
SIGNIFICANT_SAG_DIGITS: Final = 5
"""Significant digits of a sag parameter."""
COMMENT_COLUMN: Final = 40
"""Column of the comments, as in the shipped profiles."""
Change = tuple[tuple[str, ...], Any, str]


def profile_changes(profile: Profile, result: CalibrationResult) -> list[Change]:
    """List the changes of a calibration to its profile: key path, value, remark."""
    changes: list[Change] = []
    for j, r in result.joints.items():
        changes += _joint_changes(("joints", j.name.lower()), joint(profile, j), r)
    if result.turns is not None:
        changes += _turn_changes(("joints", "rot"), joint(profile, Joint.ROT), result.turns)
    if result.survey is not None:
        changes += _survey_changes(profile, result.survey)
    for command, key in ((GrappleCommand.CLOSE, "close_time_s"), (GrappleCommand.OPEN, "open_time_s")):
        if command in result.grapple_s:
            changes.append((("grapple", key), round(result.grapple_s[command], 2), "empty"))
    return changes


def _survey_changes(profile: Profile, survey: SurveyFit) -> list[Change]:
    """List the changes of zeros and sag, all or none: they were fitted together and compensate each other."""
    changes: list[Change] = []
    for j, offset in zip(OFFSETS, survey.offsets, strict=True):
        encoder = joint(profile, j).encoder
        if encoder is not None:
            zero = encoder.zero_counts + round(encoder.direction * offset / encoder.unit_per_count)
            zero = zero % encoder.total_counts if encoder.kind == "rotary" else zero
            remark = f"by survey, {offset:+.4f} {'m' if j is Joint.EXT else 'rad'}"
            changes.append((("joints", j.name.lower(), "encoder", "zero_counts"), zero, remark))
    remarks = {
        "head_rad_m": "lean of the column per metre of the stick pin's reach",
        "pin_rad_m": "and per metre of the hanger pin's reach",
        "rest_rad": "less this",
        "load_rad_nm": "lean per Nm of a load",
        "head_nm_m": "moment of the empty crane at the lift joint, by its pressures",
        "pin_nm_m": "and per metre of the hanger pin's reach",
    }
    for name, remark in remarks.items():
        value = float(f"{getattr(survey.sag, name):.{SIGNIFICANT_SAG_DIGITS}g}")
        changes.append((("sag", name), value, remark))
    return changes


def _joint_changes(path: tuple[str, ...], spec: JointSpec, r: JointResult) -> list[Change]:
    valve, unit = r.valve, "m" if r.joint is Joint.EXT else "rad"
    # A profile's full speeds hold at the lever's nominal arm; they were measured elsewhere.
    arm = lever_share(spec.valve, valve.at)
    fulls = [arm * full for full in valve.full_speeds]
    where = f"measured at {r.joint.name.lower()} {valve.at:+.2f} {unit}"
    changes = _valve_changes(path, valve.deadbands, fulls, ("middle of the hysteresis", f"{unit}/s {where}"))
    hysteresis, exponent = round(100.0 * valve.hysteresis, 2), round(valve.exponent, 3)
    changes.append(((*path, "valve", "hysteresis_pct"), hysteresis, "play of the spool, whole width"))
    changes.append(((*path, "valve", "exponent"), exponent, "metering curve from dead-band to full speed"))
    changes[:0] = _limit_changes(path, spec, fulls, unit)
    if r.delay is not None:
        changes.append(((*path, "valve", "delay_s"), round(r.delay.delay_s, 4), "dead time, command to spool"))
        changes.append(((*path, "valve", "lag_s"), round(r.delay.lag_s, 4), "of the spool"))
    return changes + _gain_changes(path, spec, r)


def _gain_changes(path: tuple[str, ...], spec: JointSpec, r: JointResult) -> list[Change]:
    """Lower the gain where the profile's would oscillate with the measured dead time."""
    borne, given = borne_gain_1_s(spec, r), spec.law.kp_1_s
    if borne >= given:
        return []
    assert r.delay is not None
    remark = f"lowered from {given:g}: with {1e3 * r.delay.delay_s:.0f} ms of dead time that would oscillate"
    return [((*path, "law", "kp_1_s"), borne, remark)]


def lowered_gains(changed: Sequence[Change]) -> list[str]:
    """Write a sentence for each joint whose loop gain a calibration has lowered."""
    return [
        f"{path[1]}: kp_1_s {value:g} 1/s, {remark}; it follows its path more slowly"
        for path, value, remark in changed
        if path[-2:] == ("law", "kp_1_s")
    ]


def _turn_changes(path: tuple[str, ...], spec: JointSpec, turns: TurnFit) -> list[Change]:
    sides = (turns.plus, turns.minus)
    fulls = [side.full_speed for side in sides]
    remarks = ("by surveyed turns, play and exponent as they were", "rad/s, by the same turns")
    changed = _valve_changes(path, [side.deadband for side in sides], fulls, remarks)
    return _limit_changes(path, spec, fulls, "rad") + changed


def _valve_changes(
    path: tuple[str, ...], deadbands: Sequence[float], fulls: Sequence[float], remarks: tuple[str, str]
) -> list[Change]:
    """List the changes of dead-bands [share of full command] and full speeds, plus and minus."""
    sides = ("plus", "minus")
    changes: list[Change] = []
    for side, deadband in zip(sides, deadbands, strict=True):
        changes.append(((*path, "valve", f"deadband_{side}_pct"), round(100.0 * deadband, 2), remarks[0]))
    for side, full in zip(sides, fulls, strict=True):
        changes.append(((*path, "valve", f"full_speed_{side}"), round(full, 4), remarks[1]))
    return changes


def _limit_changes(path: tuple[str, ...], spec: JointSpec, fulls: Sequence[float], unit: str) -> list[Change]:
    """Lower the speed limit where the valve cannot reach the profile's."""
    slowest = min(fulls)
    if slowest >= spec.speed_limit:
        return []
    limit = round(SPEED_LIMIT_SHARE * slowest, 4)
    return [((*path, "speed_limit"), limit, f"{unit}/s, the valve gives no more than {slowest:.3f}")]


def write_profile(source: Path, out: Path, changed: list[Change], date: str) -> None:
    """Write the calibrated copy of ``source``.

    Raises:
        InputRefused: ``out`` exists, cannot be written, or would be no valid profile.
    """
    document = tomlkit.parse(source.read_text(encoding="utf-8"))
    for path, value, remark in changed:
        table: Any = document
        for key in path[:-1]:
            if key not in table:
                table.append(key, tomlkit.table())
            table = table[key]
        _set_value(table, path[-1], value, f"# [cal] {date} {remark}")
    text = f"# Calibrated on {date}; [cal] marks what was measured on this machine.\n" + tomlkit.dumps(document)
    scratch = out.with_name(f".{out.stem}.part.toml")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_text(text, encoding="utf-8")
        load_profile(scratch)
        os.link(scratch, out)  # whole or not at all, and never over an existing file
    except ProfileError as error:
        raise InputRefused("calibration.profile-invalid", f"the calibrated profile would be refused: {error}") from None
    except FileExistsError:
        raise InputRefused(
            "calibration.profile-exists", f"{out} exists and is not overwritten; choose another --out"
        ) from None
    except OSError as error:
        raise InputRefused(
            "calibration.profile-unwritable",
            f"{out}: the profile cannot be written: {error.strerror}; choose another --out",
        ) from None
    finally:
        scratch.unlink(missing_ok=True)


def _set_value(table: Any, key: str, value: Any, comment: str) -> None:
    item: Item = tomlkit.item(value)
    room = COMMENT_COLUMN - len(f"{key} = {item.as_string()}") - 1
    table[key] = item
    table[key].trivia.comment_ws = " " * max(1, room)
    table[key].trivia.comment = comment
