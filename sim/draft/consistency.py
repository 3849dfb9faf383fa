"""Whether the truth of a machine and its profile can be about one machine: what the plant would fail or lie about."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from machine.joints import JOINTS
from machine.profile import Profile, encoders, joint
from runtime.errors import Problem
from sim.errors import PlantError
from sim.truth.load import Truth, load_truth

FLOW_SHARE: Final = 0.15
"""Oil per motion of truth and profile may differ by this share: a profile rounds, and nobody measures a bore."""


def truth_problems(profile: Profile, choice: str) -> list[Problem]:
    """What is wrong with the truth of this choice (`sim.individual`) for the machine of ``profile``."""
    try:
        truth = load_truth(choice, 0, profile.name)
    except PlantError as error:
        return [Problem(error.code, str(error))]
    return [*_parts(profile, truth)] or [*_joints(profile, truth)]


def _parts(profile: Profile, truth: Truth) -> Iterator[Problem]:
    names = [j.name.lower() for j in JOINTS]
    links = ("mast", "boom", "stick", "telescope", "hanger", "fork", "rotator", "tong")
    sensed = {JOINTS[n].name.lower() for n in encoders(profile) if n < len(JOINTS)}
    wanted = (("links", links), ("functions", (*names, "grapple")), ("encoders", sensed), ("cameras", profile.cameras))
    for section, keys in wanted:
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
