"""The questionnaire about a machine: what can be read on a data sheet or measured with a tape, and its answers.

Every field is a question; its description is the text that a person reads.  SI units: m, rad, s, kg, Pa; the telescope
("ext") in m.  Keys that a profile has too have the same name there (`machine.profile`).
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from machine.loading.structure import Problem, build
from machine.profile import KeepOut
from runtime.errors import InputRefused

STRAIGHT_RAD: Final = 1.5707963267948966


def _q(description: str, **limits: Any) -> Any:
    return msgspec.Meta(description=description, **limits)


Name = Annotated[str, _q("name: a to z, 0 to 9 and _; the files are called after it", pattern="^[a-z][a-z0-9_]{0,31}$")]


class GeometryAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The crane's chain to the hanger pin and the hanging grapple.  Base: on the slew axis, z up."""

    d1_m: Annotated[float, _q("height of the boom pin above the base origin")]
    a1_m: Annotated[float, _q("boom pin ahead of the slew axis, negative: behind it")]
    a2_m: Annotated[float, _q("boom pin to stick pin", gt=0.0)]
    a3_m: Annotated[float, _q("telescope's axis off the stick pin")]
    d4_m: Annotated[float, _q("stick pin to hanger pin along the telescope, at extension 0", gt=0.0)]
    hanger_to_fork_m: Annotated[float, _q("hanger pin to the second passive hinge", gt=0.0)]
    fork_to_rotator_m: Annotated[float, _q("second passive hinge to the rotator's flange", gt=0.0)]
    rotator_to_tong_pivot_m: Annotated[float, _q("rotator's flange to the pivots of the tongs", gt=0.0)]
    theta1_offset_rad: Annotated[float, _q("direction of the boom at slew 0, from base x towards y")] = 0.0
    theta2_offset_rad: Annotated[float, _q("angle of the line boom pin to stick pin at lift 0")] = 0.0
    theta3_offset_rad: Annotated[float, _q("pi/2: the telescope goes on straight along the boom at tilt 0")] = (
        STRAIGHT_RAD
    )


class EncoderAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A CANopen encoder (CiA 406)."""

    node: Annotated[int, _q("node number on crane0; crane.dbc has a frame for it", ge=1, le=127)]
    total_counts: Annotated[int, _q("counts of a turn, or of the measuring length (6002h)", ge=2)]
    direction: Annotated[Literal[-1, 1], _q("1: counts rise with the joint; -1: they fall")] = 1
    zero_counts: Annotated[int | None, _q("counts at joint 0; none: middle of a turn, 0 of a length")] = None
    unit_m: Annotated[float | None, _q("linear encoder: m per count (6005h)")] = None


class DriveAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A cylinder (bore, rod, lever arm) or a motor (displacement)."""

    bore_m: Annotated[float | None, _q("cylinder: bore")] = None
    rod_m: Annotated[float | None, _q("cylinder: rod")] = None
    lever_m: Annotated[float, _q("lever arm for which the full speeds hold; telescope: 1, with chains 0.5")] = 1.0
    lever_at: Annotated[tuple[float, ...], _q("joint positions with another lever arm")] = ()
    levers_m: Annotated[tuple[float, ...], _q("lever arms there")] = ()
    displacement_m3_rad: Annotated[float | None, _q("motor: oil per radian of the joint")] = None


class JointAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One joint: range, speeds, sensor, drive."""

    lower: Annotated[float, _q("lowest position")]
    upper: Annotated[float, _q("highest position")]
    speed_limit: Annotated[float, _q("greatest speed that work may use", gt=0.0)]
    acceleration_limit: Annotated[float, _q("greatest acceleration", gt=0.0)]
    full_speed_plus: Annotated[float, _q("speed at full spool, positive side", gt=0.0)]
    full_speed_minus: Annotated[float, _q("speed at full spool, negative side", gt=0.0)]
    drive: DriveAnswers
    encoder: EncoderAnswers | None = None
    deadband_pct: Annotated[float, _q("dead-band of the spool on either side [%]")] = 12.0
    delay_s: Annotated[float, _q("dead time of the valve")] = 0.08
    lag_s: Annotated[float, _q("lag of the spool behind the dead time")] = 0.04
    oil_s: Annotated[float, _q("further delay by pump and oil")] = 0.0


class JointsAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The five joints of the chain."""

    slew: JointAnswers
    lift: JointAnswers
    tilt: JointAnswers
    ext: JointAnswers
    rot: JointAnswers


class PumpAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The load-sensing pump."""

    flow_m3_s: Annotated[float, _q("flow at working speed", gt=0.0)]
    relief_pa: Annotated[float, _q("pressure of the main relief valve", gt=1e6)]
    sharing: Annotated[
        Literal["pre_compensated", "post_compensated"], _q("valve block when the flow does not suffice")
    ] = "pre_compensated"


class MassAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Masses of the links, and what the crane lifts."""

    column_kg: Annotated[float, _q("column above the slew bearing", gt=0.0)]
    boom_kg: Annotated[float, _q("boom with its cylinders", gt=0.0)]
    stick_kg: Annotated[float, _q("stick without the telescope", gt=0.0)]
    telescope_kg: Annotated[float, _q("telescope", gt=0.0)]
    grapple_kg: Annotated[float, _q("all that hangs: hanger, rotator and grapple", gt=0.0)]
    lifting_moment_nm: Annotated[float, _q("greatest moment about the boom pin that the lift holds", gt=0.0)]


class GrappleAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The grapple: two tongs that interleave when they close."""

    opening_m: Annotated[float, _q("between the tips, fully open", gt=0.0)]
    pivots_m: Annotated[float, _q("between the pivots of the tongs", ge=0.0)]
    tong_m: Annotated[float, _q("pivot to tip of a tong", gt=0.0)]
    close_time_s: Annotated[float, _q("time to close from fully open", gt=0.0)]
    open_time_s: Annotated[float, _q("time to open", gt=0.0)]
    hold_pressure_bar: Annotated[float, _q("closing pressure that says: gripped", gt=0.0)]
    displacement_m3_rad: Annotated[float, _q("oil per radian of the tongs", gt=0.0)]
    opening_sensor: Annotated[bool, _q("whether the opening is measured")] = False
    closed_rad: Annotated[float, _q("travel of a tong, open to empty close", gt=0.5, lt=3.0)] = 2.234


class BunkAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The load bunk."""

    center_m: Annotated[tuple[float, float], _q("middle of its floor, base frame")]
    length_m: Annotated[float, _q("length", gt=0.0)]
    width_m: Annotated[float, _q("width between the stakes", gt=0.0)]
    floor_z_m: Annotated[float, _q("floor above the base origin")]
    stake_height_m: Annotated[float, _q("stakes above the floor", ge=0.0)]
    yaw_rad: Annotated[float, _q("direction of the logs in it, from base x")] = 0.0


class WorkspaceAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where the logs lie."""

    ground_z_m: Annotated[float, _q("ground under the base origin, negative")]
    pick_center_m: Annotated[tuple[float, float], _q("middle of the place where logs lie, base frame")]
    pick_half_size_m: Annotated[float, _q("half its edge", gt=0.0)] = 1.0


class HomeAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pose in which the empty crane stands well."""

    lift: Annotated[float, _q("boom")]
    tilt: Annotated[float, _q("stick")]
    ext: Annotated[float, _q("telescope")]


class WoodAnswers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The logs that the plant shall draw."""

    length_m: Annotated[tuple[float, float], _q("shortest and longest")] = (2.5, 3.0)
    diameter_m: Annotated[tuple[float, float], _q("thinnest and thickest, in the middle")] = (0.12, 0.30)
    density_kg_m3: Annotated[float, _q("density", gt=100.0)] = 800.0


class Answers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All answers about a machine that stands still while its crane works."""

    name: Name
    title: Annotated[str, _q("name for people")]
    kinematics: GeometryAnswers
    joints: JointsAnswers
    pump: PumpAnswers
    masses: MassAnswers
    grapple: GrappleAnswers
    bunk: BunkAnswers
    workspace: WorkspaceAnswers
    home: HomeAnswers
    wood: WoodAnswers = WoodAnswers()
    rate_hz: Annotated[int, _q("control rate", ge=50, le=1000)] = 200
    keep_out: dict[str, KeepOut] = {}


def answers_of(raw: dict[str, Any], where: str) -> Answers:
    """Check the answers of parsed TOML; ``where`` begins every line of an error.

    Raises:
        InputRefused: a key is missing or unknown, or a value has the wrong type or is impossible.
    """
    problems: list[Problem] = []
    built = build(Answers, raw, "", problems)
    if not problems:
        problems = list(_contradictions(built))
    if problems:
        raise InputRefused("answers.wrong", "\n".join(f"{where}: {problem}" for problem in problems))
    answers: Answers = built
    return answers


def read_answers(path: Path) -> dict[str, Any]:
    """Read the parsed TOML of a file of answers; raises InputRefused."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputRefused("answers.unreadable", f"{path}: the answers cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputRefused("answers.broken-toml", f"{path}: not a TOML file: {error}") from None


def _contradictions(answers: Answers) -> Iterator[Problem]:
    """Find what no profile could show any more: drives neither cylinder nor motor, tongs that do not close."""
    for name in answers.joints.__struct_fields__:
        drive: DriveAnswers = getattr(answers.joints, name).drive
        path = f"joints.{name}.drive"
        if (drive.bore_m is None) == (drive.displacement_m3_rad is None):
            yield Problem("answers.drive", path, "give either bore_m and rod_m of a cylinder or displacement_m3_rad")
        elif not drive.lever_m > 0.0:
            yield Problem("answers.lever", f"{path}.lever_m", "a lever arm is greater than 0")
        elif drive.bore_m is not None and not 0.0 < (drive.rod_m or 0.0) < drive.bore_m:
            yield Problem("answers.rod", f"{path}.rod_m", f"the rod must be thinner than the bore of {drive.bore_m} m")
        if len(drive.levers_m) != len(drive.lever_at):
            text = f"{len(drive.levers_m)} lever arms for {len(drive.lever_at)} positions; give one for each lever_at"
            yield Problem("answers.levers", f"{path}.levers_m", text)
        encoder: EncoderAnswers | None = getattr(answers.joints, name).encoder
        if encoder is not None and (encoder.unit_m is not None) != (name == "ext"):
            text = "only the telescope has a linear encoder, and it needs unit_m, the metres per count"
            yield Problem("answers.encoder-unit", f"joints.{name}.encoder.unit_m", text)
    grapple = answers.grapple
    if not grapple.pivots_m < grapple.opening_m < grapple.pivots_m + 2.0 * grapple.tong_m:
        text = (
            f"tongs of {grapple.tong_m} m on pivots {grapple.pivots_m} m apart open to more than {grapple.pivots_m} m "
            f"and less than {grapple.pivots_m + 2.0 * grapple.tong_m:.3g} m"
        )
        yield Problem("answers.opening", "grapple.opening_m", text)
