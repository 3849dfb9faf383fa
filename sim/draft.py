"""The truth of a drafted machine, complete: with the inertias that follow from its own links."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final

import msgspec

from machine.draft.answers import Answers, DriveAnswers, JointAnswers
from machine.draft.toml_text import (
    BOOM_CENTRE,
    DERIVED,
    GIVEN,
    LEGEND,
    START,
    STICK_CENTRE,
    TELESCOPE_CENTRE,
    Line,
    table,
    tong,
    unit_per_count,
)
from machine.joints import JOINTS, Joint
from machine.profile import Profile, encoders, joint
from runtime.errors import Problem
from sim.bullet.body import Body, JointDef, urdf_text
from sim.bullet.client import BulletClient, new_client
from sim.errors import PlantError
from sim.mechanics.crane import FLEX_JOINTS, crane_links
from sim.truth.load import Truth, load_truth

# -- The crane of a machine as URDF, for other tools: the plant's links and joints with a rigid column.


def crane_urdf(profile: Profile, truth: Truth) -> str:
    """Write the robot ``NAME``.  Its joints have the names and ranges of the profile; ``hanger`` is the hanger pin."""
    links, joints = crane_links(profile, truth)
    return urdf_text(profile.name, links, [_outward(profile, joint) for joint in joints])


def _outward(profile: Profile, joint: JointDef) -> JointDef:
    if joint.name in FLEX_JOINTS:
        return replace(joint, kind="fixed")
    spec = profile.joints.get(joint.name)
    return joint if spec is None else replace(joint, lower=spec.lower, upper=spec.upper)


# -- The truth of a machine as TOML, from the answers of its questionnaire: what a virtual individual of it is like.
#
# What nobody asks for is scaled from the two shipped machines, whose figures agree within a third when taken per
# mass, per oil or per moment (docs/reference/machines.md, docs/reference/plant-model.md).  The individual differs a
# little from its profile, as a real one does, so that a calibration has something to find.


STOP_MARGIN: Final = 0.03
"""Hard stops outside the working range [rad, m]."""
DEADBANDS, FULL_SPEEDS, DELAY = (1.04, 0.96), (1.02, 0.99), 0.94
"""The individual's valves over its profile's: plus and minus side; dead time."""
BEARING_SHARE, COLUMN_SHARE = 0.19, 0.097
"""Slew bearing over the height of the boom pin; width of the column over the boom."""
BEAMS: Final = ((0.055, 0.072), (0.065, 0.072), (0.046, 0.046))
"""Width and height of boom, stick and telescope over their lengths."""
STIFFNESS_PER_MOMENT_1_RAD: Final = 22.5
"""Stiffness of the column over the lifting moment."""
HANGING: Final = {"hanger": 0.06, "fork": 0.25, "rotator": 0.32, "tong": 0.185}
"""Shares of the hanging mass; there are two tongs."""
FRICTION_PA: Final = {"slew": 4.3e5, "lift": 8e4, "tilt": 8e4, "ext": 1.55e5, "rot": 5.4e5, "grapple": 1.7e5}
"""Dry friction over the area of chamber A."""
VISCOUS_PA_S: Final = {"slew": 1.0e6, "lift": 5.6e6, "tilt": 5.6e6, "ext": 8.6e5, "rot": 4.5e5, "grapple": 2.7e5}
STRIBECK: Final = {"slew": 0.02, "lift": 0.01, "tilt": 0.01, "ext": 0.01, "rot": 0.03, "grapple": 0.03}
RELAXATION_1_S: Final = {"slew": 3.6, "lift": 3.2, "tilt": 3.2, "ext": 4.0, "rot": 3.6, "grapple": 4.0}
STICTION: Final = 1.3
PHASES_RAD: Final = (0.3, 1.1, 2.0, 0.0, 4.0)
"""Phase of the encoders' eccentricity, by joint."""
SHOCK_OVER_RELIEF_PA: Final = 3e6
CLOSING_RELIEF: Final = 0.87
"""Limit of the grapple's closing port over the pump's relief."""
GRAPPLE_SPEED: Final = 1.08
SPREAD: Final = {
    "mass": 0.15,
    "flexibility": 0.20,
    "friction": 0.30,
    "deadband": 0.20,
    "gain": 0.20,
    "hysteresis": 0.40,
    "delay_min_s": 0.040,
    "delay_max_s": 0.150,
    "pump": 0.10,
    "bulk": 0.16,
    "offset": 0.003,
    "eccentricity": 0.5,
    "antenna_m": 0.03,
}
"""As of the shipped machines (docs/reference/machines.md section 14)."""


def truth_text(answers: Answers, least_inertia: dict[str, float]) -> str:
    """Write the truth; ``least_inertia`` by function."""
    kin, home, wood, pump = answers.kinematics, answers.home, answers.wood, answers.pump
    hanging, moment = answers.masses.grapple_kg, answers.masses.lifting_moment_nm
    stiffness = STIFFNESS_PER_MOMENT_1_RAD * moment
    tongs = HANGING["tong"] * hanging
    parts = [
        f"# {answers.title}: its nominal individual, for the plant alone; drafted by `timberhand machine new`.\n"
        f"#\n{LEGEND}\n",
        table("", [("machine", answers.name, GIVEN)]),
        table(
            "home",
            (
                ("slew", 0.0, START),
                ("lift", home.lift, GIVEN),
                ("tilt", home.tilt, GIVEN),
                ("ext", home.ext, GIVEN),
                ("rot", 0.0, START),
            ),
        ),
        table(
            "steel",
            (
                ("bearing_z_m", round(BEARING_SHARE * kin.d1_m, 4), DERIVED),
                ("beams_m", _beams(answers), DERIVED),
                ("column_m", round(COLUMN_SHARE * kin.a2_m, 3), DERIVED),
            ),
        ),
        *(table(f"links.{name}", lines) for name, lines in _links(answers).items()),
        table(
            "structure",
            (
                ("hanger_damping_nm_s_rad", round(0.45 * hanging, 1), DERIVED),
                ("fork_damping_nm_s_rad", round(0.45 * hanging, 1), DERIVED),
                ("flex_pitch_nm_rad", stiffness, DERIVED),
                ("flex_roll_nm_rad", stiffness, DERIVED),
                ("flex_damping_s", 0.007, START),
                ("tong_sync_nm_rad", round(900.0 * tongs, 1), DERIVED),
                ("tong_sync_nm_s_rad", round(6.5 * tongs, 1), DERIVED),
            ),
        ),
        table(
            "contact",
            (
                ("log_friction", 0.8, START),
                ("ground_friction", 1.0, START),
                ("tong_friction", 0.5, START),
                ("bunk_friction", 0.6, START),
                ("log_rolling_m", 0.02, START),
            ),
        ),
        table(
            "wood",
            (
                ("length_m", wood.length_m, GIVEN),
                ("diameter_m", wood.diameter_m, GIVEN),
                ("taper_m_m", (0.003, 0.012), START),
                ("sweep_max", 0.02, START),
                ("density_kg_m3", wood.density_kg_m3, GIVEN),
                ("density_spread", 0.08, START),
            ),
        ),
        table(
            "supply",
            (
                ("sharing", pump.sharing, GIVEN),
                ("pump_flow_m3_s", pump.flow_m3_s, GIVEN),
                ("pressure_margin_pa", 2.0e6, START),
                ("relief_pa", pump.relief_pa, GIVEN),
                ("shock_pa", pump.relief_pa + SHOCK_OVER_RELIEF_PA, DERIVED),
                ("tank_pa", 0.2e6, START),
                ("build_up_s", 0.06, START),
                ("bulk_modulus_pa", 0.85e9, START),
                ("leakage_m3_s_pa", 5.0e-16, START),
            ),
        ),
        *(_function(answers, j, least_inertia) for j in JOINTS),
        _grapple(answers, least_inertia),
        *(_encoder(answers, j) for j in JOINTS),
        table("spread", [(key, value, START) for key, value in SPREAD.items()]),
        "[cameras]\n",
    ]
    return "".join(parts).rstrip() + "\n"


def _beams(answers: Answers) -> list[tuple[float, float]]:
    kin = answers.kinematics
    return [(round(w * m, 3), round(h * m, 3)) for (w, h), m in zip(BEAMS, (kin.a2_m, kin.d4_m, kin.d4_m), strict=True)]


def _links(answers: Answers) -> dict[str, list[Line]]:
    """Compute masses, centres of mass and inertias of uniform beams; the tongs' as of the shipped grapples."""
    kin, masses = answers.kinematics, answers.masses
    (_, boom), (_, stick), (_, inner) = _beams(answers)
    column, height = COLUMN_SHARE * kin.a2_m, (1.0 - BEARING_SHARE) * kin.d1_m
    tilt = kin.theta3_offset_rad + kin.theta2_offset_rad - math.pi / 2  # of the telescope's axis in the stick's frame
    along, across = (math.cos(tilt), math.sin(tilt)), (-math.sin(tilt), math.cos(tilt))

    def on_axis(share: float, off_m: float) -> tuple[float, float, float]:
        out_m = share * kin.d4_m
        return 0.0, off_m * across[0] + out_m * along[0], off_m * across[1] + out_m * along[1]

    def beam(mass: float, length: float, thick: float) -> tuple[float, float, float]:
        turning = mass * length**2 / 12.0
        return turning, 0.4 * mass * thick**2, turning

    def hung(name: str, length: float, inertia: Sequence[float]) -> list[Line]:
        mass = HANGING[name] * masses.grapple_kg
        return _link(mass, (0.0, 0.0, -length), tuple(mass * i for i in inertia))

    upright = masses.column_kg * height**2 / 10.0
    _, out, down = tong(answers.grapple)
    mass, chord = HANGING["tong"] * masses.grapple_kg, answers.grapple.tong_m
    own = tuple(mass * chord**2 * i for i in (0.084, 0.108, 0.084))
    return {
        "mast": _link(
            masses.column_kg, (0.0, 0.0, 0.48 * height), (upright, upright, masses.column_kg * column**2 / 2.0)
        ),
        "boom": _link(masses.boom_kg, (0.0, BOOM_CENTRE * kin.a2_m, 0.0), beam(masses.boom_kg, kin.a2_m, boom)),
        "stick": _link(masses.stick_kg, on_axis(STICK_CENTRE, kin.a3_m), beam(masses.stick_kg, kin.d4_m, stick)),
        "telescope": _link(
            masses.telescope_kg, on_axis(TELESCOPE_CENTRE, 0.0), beam(masses.telescope_kg, kin.d4_m, inner)
        ),
        "hanger": hung("hanger", 0.55 * kin.hanger_to_fork_m, (0.01, 0.01, 0.005)),
        "fork": hung("fork", 0.5 * kin.fork_to_rotator_m, (0.0137, 0.0137, 0.009)),
        "rotator": hung("rotator", 0.6 * kin.rotator_to_tong_pivot_m, (0.0356, 0.0575, 0.0575)),
        "tong": _link(mass, (0.655 * out, 0.0193, -0.48 * down), own),
    }


def _link(mass: float, com: Sequence[float], inertia: Iterable[float]) -> list[Line]:
    return [
        ("mass_kg", round(mass, 2), GIVEN),
        ("com_m", tuple(round(v, 4) for v in com), DERIVED),
        ("inertia_kg_m2", tuple(round(v, 4) for v in inertia), DERIVED),
    ]


def _areas(drive: DriveAnswers) -> tuple[float, float]:
    """Return the piston areas [m^2], or the displacement of a motor [m^3/rad]."""
    if drive.displacement_m3_rad is not None:
        return drive.displacement_m3_rad, drive.displacement_m3_rad
    bore, rod = drive.bore_m or 0.0, drive.rod_m or 0.0
    return math.pi / 4.0 * bore**2, math.pi / 4.0 * (bore**2 - rod**2)


def _levers(joint: JointAnswers) -> tuple[list[float], list[float]]:
    """Tabulate the lever arm from hard stop to hard stop: the table of the answers, straight on beyond its ends."""
    low, high, drive = joint.lower - STOP_MARGIN, joint.upper + STOP_MARGIN, joint.drive
    if not drive.lever_at:
        return [round(low, 6), round(high, 6)], [drive.lever_m, drive.lever_m]
    at, arms = list(drive.lever_at), list(drive.levers_m)
    inner = [(q, arm) for q, arm in zip(at, arms, strict=True) if low < q < high]
    ends = [(q, _on_line(at, arms, q)) for q in (low, high)]
    rows = [ends[0], *inner, ends[1]]
    return [round(q, 6) for q, _ in rows], [round(arm, 4) for _, arm in rows]


def _on_line(at: Sequence[float], arms: Sequence[float], q: float) -> float:
    """Interpolate straight; beyond the table return its first or last value."""
    if q <= at[0] or len(at) == 1:
        return arms[0]
    for (a, x), (b, y) in zip(zip(at, arms, strict=True), zip(at[1:], arms[1:], strict=True), strict=False):
        if q <= b:
            return x + (y - x) * (q - a) / (b - a)
    return arms[-1]


def _cylinder(name: str, areas: tuple[float, float], at: Any, arms: Any, nominal: float, inertia: float) -> str:
    motor = name in ("slew", "rot", "grapple")
    dead = max(0.5e-3, 0.75 * areas[0]) if motor else max(0.4e-3, 0.14 * areas[0])
    dry = FRICTION_PA[name] * areas[0]
    return table(
        f"functions.{name}.cylinder",
        (
            ("area_a", areas[0], f"{DERIVED} from the drive"),
            ("area_b", areas[1], f"{DERIVED} from the drive"),
            ("dead_volume_m3", round(dead, 6), START),
            ("arm_at", at, DERIVED),
            ("arm", arms, DERIVED),
            ("arm_nominal", nominal, DERIVED),
            ("coulomb", round(dry, 2), DERIVED),
            ("stiction", round(STICTION * dry, 2), DERIVED),
            ("stribeck_speed", STRIBECK[name], START),
            ("viscous", round(VISCOUS_PA_S[name] * areas[0], 2), DERIVED),
            ("relaxation_1_s", RELAXATION_1_S[name], START),
            ("least_inertia", round(inertia, 3), f"{DERIVED} from the links"),
        ),
    )


def _valve(name: str, valve: dict[str, float]) -> str:
    known = {"spool_rad_s": 40.0, "spool_zeta": 0.8, "hysteresis": 0.02, "exponent": 1.04}
    lines = [(key, value, START) for key, value in known.items()]
    return table(f"functions.{name}.valve", [*lines, *((k, round(v, 6), DERIVED) for k, v in valve.items())])


def _function(answers: Answers, which: Joint, least_inertia: dict[str, float]) -> str:
    name = which.name.lower()
    joint: JointAnswers = getattr(answers.joints, name)
    at, arms = _levers(joint)
    relief, share = answers.pump.relief_pa, joint.deadband_pct / 100.0
    return _cylinder(name, _areas(joint.drive), at, arms, joint.drive.lever_m, least_inertia[name]) + _valve(
        name,
        {
            "delay_s": DELAY * joint.delay_s,
            "deadband_plus": DEADBANDS[0] * share,
            "deadband_minus": DEADBANDS[1] * share,
            "full_speed_plus": FULL_SPEEDS[0] * joint.full_speed_plus,
            "full_speed_minus": FULL_SPEEDS[1] * joint.full_speed_minus,
            "limit_plus_pa": relief,
            "limit_minus_pa": relief,
        },
    )


def _grapple(answers: Answers, least_inertia: dict[str, float]) -> str:
    """Write the grapple's part; a positive command opens, so the arm is negative."""
    grapple, relief = answers.grapple, answers.pump.relief_pa
    at = [-STOP_MARGIN, grapple.closed_rad + STOP_MARGIN]
    areas = (grapple.displacement_m3_rad, grapple.displacement_m3_rad)
    return _cylinder("grapple", areas, at, [-1.0, -1.0], -1.0, least_inertia["grapple"]) + _valve(
        "grapple",
        {
            "delay_s": DELAY * answers.joints.rot.delay_s,
            "deadband_plus": 0.10,
            "deadband_minus": 0.10,
            "full_speed_plus": GRAPPLE_SPEED * grapple.closed_rad / grapple.open_time_s,
            "full_speed_minus": GRAPPLE_SPEED * grapple.closed_rad / grapple.close_time_s,
            "limit_plus_pa": relief,
            "limit_minus_pa": CLOSING_RELIEF * relief,
            "check_ratio": 3.5,
        },
    )


def _encoder(answers: Answers, which: Joint) -> str:
    encoder = getattr(answers.joints, which.name.lower()).encoder
    if encoder is None:
        return ""
    turns = encoder.unit_m is None
    return table(
        f"encoders.{which.name.lower()}",
        (
            ("offset", 0.0, START),
            ("eccentricity", 5.0e-4 if turns else 0.0, START),
            ("phase_rad", PHASES_RAD[which], START),
            ("noise", max(0.3 * unit_per_count(encoder), 1e-5), DERIVED),
            ("latency_s", 0.0025, START),
        ),
    )


# -- Half the smallest inertia that each function shows its drive, in poses over its whole range (`sim.truth`).
#
# Every joint is free and at rest, without gravity: a torque on one of them for a moment, and its acceleration, give
# the inertia that this drive feels while all others give way.


POSES_PER_JOINT: Final = 4
JAWS: Final = (0.0, 0.5, 1.0)
"""Shares of the tongs' travel."""
STEP_S: Final = 1e-4
TONGS: Final = ("tong_left", "tong_right")


def least_inertia(profile: Profile, truth: Truth) -> dict[str, float]:
    """Compute the least inertia by function [kg m^2, kg]; only the links of ``truth`` are used."""
    client = new_client()
    try:
        client.setGravity(0.0, 0.0, 0.0)
        client.setPhysicsEngineParameter(fixedTimeStep=STEP_S)
        body = Body(client, *crane_links(profile, truth), fixed=True)
        driven = {name: (name,) for name in profile.joints} | {"grapple": TONGS}
        least = dict.fromkeys(driven, float("inf"))
        shares = [i / (POSES_PER_JOINT - 1) for i in range(POSES_PER_JOINT)]
        for lift, tilt, ext, jaw in product(shares, shares, shares, JAWS):
            pose = dict.fromkeys(body.names, 0.0)
            for name, share in (("lift", lift), ("tilt", tilt), ("ext", ext)):
                spec = profile.joints[name]
                pose[name] = spec.lower + share * (spec.upper - spec.lower)
            pose["hanger"] = -(pose["lift"] + pose["tilt"])
            pose |= dict.fromkeys(TONGS, jaw * profile.grapple.jaws.angle_rad[-1])
            for name, joints in driven.items():
                least[name] = min(least[name], _inertia(client, body, pose, joints))
        return {name: 0.5 * inertia for name, inertia in least.items()}
    finally:
        client.disconnect()


def _inertia(client: BulletClient, body: Body, pose: dict[str, float], joints: tuple[str, ...]) -> float:
    """Compute the torque over the mean acceleration of the joints that share it."""
    body.place(pose)
    body.apply([body.index[j] for j in joints], [1.0 / len(joints)] * len(joints))
    client.stepSimulation()
    rates = dict(zip(body.names, (s[1] for s in body.states()), strict=True))
    return STEP_S / (sum(rates[j] for j in joints) / len(joints))


# -- The truth of a drafted machine, complete


_UNKNOWN: Final = dict.fromkeys(("slew", "lift", "tilt", "ext", "rot", "grapple"), 1.0)


def truth_and_urdf(answers: Answers, profile: Profile) -> tuple[str, str]:
    """Write the texts of the truth file and of the URDF file of the machine of these answers and this profile."""
    links = msgspec.toml.decode(truth_text(answers, _UNKNOWN), type=Truth)
    return truth_text(answers, least_inertia(profile, links)), crane_urdf(profile, links)


# -- Whether the truth of a machine and its profile can be about one machine: what the plant would fail or lie about.

FLOW_SHARE: Final = 0.15
"""Oil per motion of truth and profile may differ by this share: a profile rounds, and nobody measures a bore."""


def truth_problems(profile: Profile, choice: str) -> list[Problem]:
    """List what is wrong with the truth of this choice (`sim.individual`) for the machine of ``profile``."""
    try:
        truth = load_truth(choice, 0, profile.name)
    except PlantError as error:
        return [Problem(error.code, str(error))]
    return [*_parts(profile, truth)] or [*_joints(profile, truth)]


def _parts(profile: Profile, truth: Truth) -> Iterator[Problem]:
    names = [j.name.lower() for j in JOINTS]
    links = ("mast", "boom", "stick", "telescope", "hanger", "fork", "rotator", "tong")
    sensed = {JOINTS[n].name.lower() for n in encoders(profile) if n < len(JOINTS)}
    required_sections = (
        ("links", links),
        ("functions", (*names, "grapple")),
        ("encoders", sensed),
        ("cameras", profile.cameras),
    )
    for section, keys in required_sections:
        missing = [key for key in keys if key not in getattr(truth, section)]
        if missing:
            text = f"[{section}] has no {', '.join(missing)}; the profile has, so describe what is true of it"
            yield Problem("truth.missing-part", text)


def _joints(profile: Profile, truth: Truth) -> Iterator[Problem]:
    for j in JOINTS:
        name, spec = j.name.lower(), joint(profile, j)
        cylinder = truth.functions[name].cylinder
        if not cylinder.arm_at[0] < spec.lower < spec.upper < cylinder.arm_at[-1]:
            text = (
                f"functions.{name}.cylinder.arm_at: the drive's stops {cylinder.arm_at[0]}..{cylinder.arm_at[-1]} are "
                f"inside the profile's range {spec.lower}..{spec.upper}; the joint would hit them"
            )
            yield Problem("truth.stops", text)
        sides = (("plus", spec.valve.flow_plus, cylinder.area_a), ("minus", spec.valve.flow_minus, cylinder.area_b))
        for side, flow, area in sides:
            true = area * abs(cylinder.arm_nominal)
            if abs(true - flow) > FLOW_SHARE * flow:
                text = (
                    f"functions.{name}.cylinder: piston and lever arm need {true:.3g} m^3 per unit of the joint, and "
                    f"flow_{side} of the profile is {flow:.3g}; one of the two is another cylinder"
                )
                yield Problem("truth.flow", text)
        at = getattr(truth.home, name)
        if not spec.lower <= at <= spec.upper:
            text = f"home.{name}: {at} is outside the profile's range {spec.lower}..{spec.upper}"
            yield Problem("truth.home", text)
