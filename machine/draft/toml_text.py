"""Writes TOML with the origin of every value behind it, as in the shipped profiles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

from machine.draft.answers import Answers, DriveAnswers, EncoderAnswers, GrappleAnswers, JointAnswers, MassAnswers
from machine.geometry.grapple import lowest_pin_m
from machine.joints import JOINTS, Joint
from machine.profile import KeepOut, Profile, joint

GIVEN: Final = "given"
DERIVED: Final = "derived"
START: Final = "start"
SET: Final = "set"
LEGEND: Final = """\
# Where every value comes from:
#   [given]   an answer of the questionnaire
#   [derived] computed from answers
#   [start]   a starting value of a middling loader: calibrate, then tune
#   [set]     policy and names
"""
_COLUMN: Final = 38
Line = tuple[str, Any, str]
"""Key, value, origin with an explanation."""


def value_text(value: Any) -> str:
    """Write one TOML value; floats keep all their digits."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return repr(value)


def table(path: str, lines: Iterable[Line]) -> str:
    """Write a table; ``path`` empty: the top of a file."""
    out = [f"[{path}]"] if path else []
    for key, value, origin in lines:
        kind, _, more = origin.partition(" ")
        out.append(f"{f'{key} = {value_text(value)}':<{_COLUMN}} # [{kind}]{f' {more}' if more else ''}")
    return "\n".join([*out, "", ""])


# -- Where the masses of a crane's links are, as shares of the links: from the two shipped machines, which agree.
#
# The profile needs them as weights at the two pins, the plant as centres of mass.

BOOM_CENTRE: Final = 0.46
"""Of the boom, from its pin."""
STICK_CENTRE: Final = 0.40
"""Of stick and of telescope, from the stick pin to the hanger pin at extension 0."""
TELESCOPE_CENTRE: Final = 0.46


def weights_at_pins(masses: MassAnswers) -> tuple[float, float]:
    """Compute the empty crane as weights at the stick pin and at the hanger pin [kg]."""
    links = ((masses.stick_kg, STICK_CENTRE), (masses.telescope_kg, TELESCOPE_CENTRE))
    head = BOOM_CENTRE * masses.boom_kg + sum((1.0 - share) * mass for mass, share in links)
    return head, masses.grapple_kg + sum(share * mass for mass, share in links)


# -- The guard's envelope of a machine as TOML, from its profile: a draft, which a person checks and seals.

LIMITS: Final = ("lower", "upper", "speed_limit", "acceleration_limit")
COLUMN_HALF_M: Final = 0.45
"""Half the edge of the box around the column with its foot."""
UNDER_BOOM_PIN_M: Final = 0.15
BELOW_CONTROLLER_M: Final = 0.05
"""The guard stops a pin this much lower than where the controller refuses it."""


def envelope_kinematics(profile: Profile) -> dict[str, float]:
    """Return the geometry in the guard's own terms, by key [m, rad]."""
    kin = profile.kinematics
    return {
        "boom_pin_z_m": kin.d1_m,
        "boom_pin_r_m": kin.a1_m,
        "plane_offset_rad": kin.theta1_offset_rad,
        "boom_m": kin.a2_m,
        "boom_offset_rad": kin.theta2_offset_rad,
        "telescope_offset_m": kin.a3_m,
        "stick_offset_rad": kin.theta3_offset_rad,
        "stick_m": kin.d4_m,
    }


def envelope_text(profile: Profile) -> str:
    """Write the envelope without its last line."""
    ground, kin = profile.workspace.ground_z_m, profile.kinematics
    hang_m = kin.hanger_to_fork_m + kin.fork_to_rotator_m - BELOW_CONTROLLER_M
    high = round(kin.d1_m - UNDER_BOOM_PIN_M + hang_m, 4)
    boxes = [("The column with its foot: what hangs stiff below the pin would hit it.", _column(ground, high))]
    boxes += [(f"keep_out.{name} of the profile.", _corners(box, hang_m)) for name, box in profile.keep_out.items()]
    out = [
        f"# Envelope of {profile.title},",
        "# for the guard: what this machine may do at most, whatever its profile says.",
        "#",
        "# A draft from its profile.  Check every limit against the machine; then seal the file with",
        "# `python -m controller.guard.seal FILE`.  Without the seal the guard does not start.",
        "",
        "# The hanger pin stays above this height; a grapple hangs below it.",
        f"ground_m = {value_text(round(lowest_pin_m(profile) - BELOW_CONTROLLER_M, 3))}",
        "",
        "[kinematics]",
        *(f"{key} = {value_text(value)}" for key, value in envelope_kinematics(profile).items()),
    ]
    for title, (low_m, high_m) in boxes:
        out += ["", f"# {title}", "[[boxes]]", f"low_m = {value_text(low_m)}", f"high_m = {value_text(high_m)}"]
    for j in JOINTS:
        spec = joint(profile, j)
        out += ["", f"[joints.{j.name.lower()}]", *(f"{key} = {value_text(getattr(spec, key))}" for key in LIMITS)]
    return "\n".join([*out, "", ""])


def _column(ground: float, high: float) -> tuple[list[float], list[float]]:
    return [-COLUMN_HALF_M, -COLUMN_HALF_M, ground], [COLUMN_HALF_M, COLUMN_HALF_M, high]


def _corners(box: KeepOut, hang_m: float) -> tuple[list[float], list[float]]:
    """Compute the axis-parallel box around a box that is turned about the vertical, and ``hang_m`` higher."""
    (x, y, z), (a, b, c) = box.center_m, box.half_m
    cos, sin = abs(math.cos(box.yaw_rad)), abs(math.sin(box.yaw_rad))
    dx, dy = cos * a + sin * b, sin * a + cos * b
    low, high = (x - dx, y - dy, z - c), (x + dx, y + dy, z + c + hang_m)
    return [round(v, 4) for v in low], [round(v, 4) for v in high]


# -- The profile of a machine as TOML, from the answers of its questionnaire.

DEVICE_TYPES: Final = {"rotary": 0x0001_0196, "linear": 0x0008_0196}
"""Object 1000h of a single-turn and of a linear encoder (CiA 406)."""
LAWS: Final[dict[Joint, tuple[float, float, float, float, float]]] = {
    Joint.SLEW: (0.75, 0.1, 0.02, 6.6e-4, 0.001),
    Joint.LIFT: (1.5, 0.0, 0.02, 2.1e-4, 0.001),
    Joint.TILT: (2.0, 0.0, 0.02, 4.8e-4, 0.001),
    Joint.EXT: (3.0, 0.0, 0.02, 0.0, 0.0015),
    Joint.ROT: (0.8, 0.0, 0.05, 0.0, 0.005),
}
"""kp_1_s, kd, layer, damping_per_bar, stop_band by joint: the slower shipped machine's (docs/loop-design.md)."""
GAIN_DELAY: Final = 0.2
"""Greatest product of a starting gain and the dead time of the valve."""
STABILITY_SHARE: Final = 0.9
JAW_ANGLES_RAD: Final = (0.0, 0.3, 0.6, 0.9)
"""Rows of the table of the tongs while they are open; further ones follow to the empty close."""
CLOSED_ROWS: Final = 4


def profile_text(answers: Answers, messages: Mapping[int, str]) -> str:
    """Write the profile.

    ``messages``: encoder messages of ``crane.dbc`` by their node; a node without one keeps the number as its name,
    which the profile's check refuses with the names that exist.
    """
    kin = answers.kinematics
    parts = [
        f"# {answers.title}: profile, drafted by `timberhand machine new`.\n#\n"
        '# SI units: m, rad, s; the telescope ("ext") in m.  Base frame: on the slew axis, z up.\n#\n' + LEGEND + "\n",
        table(
            "",
            (
                ("schema", 1, f"{SET} version of this layout"),
                ("name", answers.name, GIVEN),
                ("title", answers.title, GIVEN),
                ("rate_hz", answers.rate_hz, f"{GIVEN} control rate"),
                ("crane_bus", "crane0", f"{SET} the machine stands still: no machine bus"),
            ),
        ),
        table("kinematics", [(key, getattr(kin, key), GIVEN) for key in kin.__struct_fields__]),
        *(_joint_text(j, getattr(answers.joints, j.name.lower()), messages) for j in JOINTS),
        table("hydraulics", [("pump_flow_m3_s", answers.pump.flow_m3_s, GIVEN)]),
        _grapple_text(answers),
        table("bunk", [(key, getattr(answers.bunk, key), GIVEN) for key in answers.bunk.__struct_fields__]),
        table("workspace", [(k, getattr(answers.workspace, k), GIVEN) for k in answers.workspace.__struct_fields__]),
        table(
            "timeouts",
            (
                ("lease_max_ms", 200, f"{SET} a planner sends every 50 ms: three datagrams may be lost"),
                ("stop_ramp_ms", 150, f"{SET} jerk-limited stop, every function neutral within"),
                ("operator_link_ms", 1000, f"{SET} an operator who watches sends every 200 ms; 0: not watched"),
            ),
        ),
        _stability_text(answers),
        *(
            table(f"keep_out.{name}", [(key, getattr(box, key), GIVEN) for key in box.__struct_fields__])
            for name, box in answers.keep_out.items()
        ),
    ]
    return "".join(parts).rstrip() + "\n"


def flows(drive: DriveAnswers) -> tuple[float, float]:
    """Compute oil per motion on positive and negative side [m^3 per rad or m]: chambers without and with rod."""
    if drive.displacement_m3_rad is not None:
        return drive.displacement_m3_rad, drive.displacement_m3_rad
    bore, rod = drive.bore_m or 0.0, drive.rod_m or 0.0
    quarter = math.pi / 4.0 * drive.lever_m
    return quarter * bore**2, quarter * (bore**2 - rod**2)


def _joint_text(which: Joint, joint: JointAnswers, messages: Mapping[int, str]) -> str:
    name = which.name.lower()
    path = f"joints.{name}"
    kind = "prismatic" if which is Joint.EXT else "revolute"
    text = table(
        path,
        (
            ("kind", kind, SET),
            ("lower", joint.lower, GIVEN),
            ("upper", joint.upper, GIVEN),
            ("speed_limit", joint.speed_limit, GIVEN),
            ("acceleration_limit", joint.acceleration_limit, GIVEN),
        ),
    )
    if joint.encoder is not None:
        text += _encoder_text(path, joint.encoder, messages)
    plus, minus = flows(joint.drive)
    lever: list[Line] = []
    if joint.drive.lever_at:
        shares = tuple(round(arm / joint.drive.lever_m, 4) for arm in joint.drive.levers_m)
        lever = [("lever_at", joint.drive.lever_at, GIVEN), ("lever", shares, f"{DERIVED} share of the nominal arm")]
    text += table(
        f"{path}.valve",
        (
            ("signal", name.capitalize(), f"{SET} ValveCmdA or ValveCmdB"),
            ("sign", 1, f"{SET} positive command, positive motion"),
            ("deadband_plus_pct", joint.deadband_pct, f"{GIVEN} until calibrated"),
            ("deadband_minus_pct", joint.deadband_pct, f"{GIVEN} until calibrated"),
            ("hysteresis_pct", 2.0, START),
            ("exponent", 1.0, START),
            ("full_speed_plus", joint.full_speed_plus, GIVEN),
            ("full_speed_minus", joint.full_speed_minus, GIVEN),
            ("delay_s", joint.delay_s, GIVEN),
            ("lag_s", joint.lag_s, GIVEN),
            ("oil_s", joint.oil_s, GIVEN),
            ("flow_plus", plus, f"{DERIVED} from the drive"),
            ("flow_minus", minus, f"{DERIVED} from the drive"),
            *lever,
        ),
    )
    gain, kd, layer, damping, band = LAWS[which]
    kp = round(min(gain, GAIN_DELAY / joint.delay_s), 3) if joint.delay_s > 0.0 else gain
    tuned = f"{START} check with `timberhand bench loop-design`"
    return text + table(
        f"{path}.law",
        (
            ("kind", "sliding_mode", SET),
            ("kp_1_s", kp, tuned),
            ("kd", kd, START),
            ("layer", layer, START),
            ("damping_per_bar", damping, tuned),
            ("stop_band", band, START),
            ("velocity_filter_s", 0.03, START),
        ),
    )


def unit_per_count(encoder: EncoderAnswers) -> float:
    """Compute the step of an encoder [rad or m]."""
    return encoder.unit_m if encoder.unit_m is not None else 2.0 * math.pi / encoder.total_counts


def _encoder_text(path: str, encoder: EncoderAnswers, messages: Mapping[int, str]) -> str:
    kind = "rotary" if encoder.unit_m is None else "linear"
    middle = encoder.total_counts // 2 if kind == "rotary" else 0
    zero = middle if encoder.zero_counts is None else encoder.zero_counts
    return table(
        f"{path}.encoder",
        (
            ("node", encoder.node, GIVEN),
            ("message", messages.get(encoder.node, str(encoder.node)), f"{DERIVED} crane.dbc, by the node"),
            ("kind", kind, DERIVED),
            ("device_type", DEVICE_TYPES[kind], f"{DERIVED} object 1000h (CiA 406)"),
            ("total_counts", encoder.total_counts, GIVEN),
            ("unit_per_count", unit_per_count(encoder), DERIVED),
            ("zero_counts", zero, GIVEN if encoder.zero_counts is not None else f"{SET} preset (6003h)"),
            ("direction", encoder.direction, GIVEN),
            ("noise", max(unit_per_count(encoder), 1e-4), f"{START} a count, 1 sigma"),
        ),
    )


def jaw_rows(answers: Answers) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """Compute the angle [rad], half gap of the tips [m] and tips below the hanger pin [m] of tongs on two pivots."""
    grapple, kin = answers.grapple, answers.kinematics
    beside, out, down = tong(grapple)
    hang = kin.hanger_to_fork_m + kin.fork_to_rotator_m + kin.rotator_to_tong_pivot_m
    closed = grapple.closed_rad
    first = [a for a in JAW_ANGLES_RAD if a < closed / 2.0]
    step = (closed - first[-1]) / CLOSED_ROWS
    angles = [*first, *(first[-1] + step * i for i in range(1, CLOSED_ROWS)), closed]
    gaps = tuple(round(beside + out * math.cos(a) - down * math.sin(a), 4) for a in angles)
    tips = tuple(round(hang + out * math.sin(a) + down * math.cos(a), 4) for a in angles)
    return tuple(round(a, 4) for a in angles), gaps, tips


def tong(grapple: GrappleAnswers) -> tuple[float, float, float]:
    """Compute the pivot from the middle; tip of an open tong outward of its pivot and below it [m]."""
    out = (grapple.opening_m - grapple.pivots_m) / 2.0
    return grapple.pivots_m / 2.0, out, math.sqrt(grapple.tong_m**2 - out**2)


def _grapple_text(answers: Answers) -> str:
    grapple = answers.grapple
    keys = ("close_time_s", "open_time_s", "hold_pressure_bar", "opening_sensor")
    angles, gaps, tips = jaw_rows(answers)
    return table("grapple", [(key, getattr(grapple, key), GIVEN) for key in keys]) + table(
        "grapple.tongs",
        (
            ("angle_rad", angles, DERIVED),
            ("half_gap_m", gaps, DERIVED),
            ("tip_below_pin_m", tips, DERIVED),
        ),
    )


def _stability_text(answers: Answers) -> str:
    head, pin = weights_at_pins(answers.masses)
    return table(
        "stability",
        (
            ("head_kg", round(head, 1), f"{DERIVED} links as weights at the two pins"),
            ("pin_kg", round(pin, 1), DERIVED),
            ("edge_m", answers.kinematics.a1_m, f"{DERIVED} the boom pin: the lift's moment is the limit"),
            ("stabilising_nm", answers.masses.lifting_moment_nm, GIVEN),
            ("slope_nm_rad", 0.0, f"{SET} on its supports"),
            ("share", STABILITY_SHARE, SET),
        ),
    )
