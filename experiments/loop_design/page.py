"""The page docs/loop-design.md: margins of every joint, law and machine, with pictures; written, never typed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from controller.laws.feedback import LAWS
from experiments.common.result import commit, environment
from experiments.loop_design.carrier import natural
from experiments.loop_design.plots import draw
from experiments.loop_design.study import GAIN_DB, PHASE_DEG, JointStudy, Work, study
from machine.profile import Carrier, Profile

NAMES: Final = {
    "pd": "PD",
    "sliding_mode": "sliding mode",
    "super_twisting": "super-twisting",
    "pid": "plain PID",
    "undamped": "the profile's without pressure feedback",
}
INTRODUCTION: Final = (
    "Each joint's loop as a linear model: the true valve (dead time, second-order spool, gain), the mechanics it "
    "drives (oil springs, inertia, the hanging load as a pendulum, the column that gives way), the encoder, and "
    "the controller as it runs: sampled, with the estimator's Kalman gains, delay compensation and pressure "
    "feedback, cut at the velocity command. The mechanics are linearised from the opened physics, near, working "
    "and far reach, empty and loaded, either way, valve a little and much open; dead times and gains over the "
    "whole spread of the truth. The controller knows none of that, only the profile. Tests drive the running code "
    "with sines and compare it with these responses, and python-control judges the worst loop again. `timberhand "
    "bench loop-design --docs docs` computes everything and writes this page; no number is typed."
)
CARRIER: Final = (
    "The carrier's loops (docs/reference/machines.md sections 7.2 and 7.3). *heading* is paper B's law: bearing to the waypoint less heading, to "
    "the rate of the articulation, judged slow and at cruising speed, far from the waypoint and near, with the "
    "receiver's latency and the odometry between its samples. *articulation* closes a wanted angle on the encoder, "
    "*swing arm* a height. Without valve and receiver the heading is L s^2 + Kp lr s + Kp v = 0:"
)
LEAST: Final = (
    "Least margins with every law that a profile may name, and what the profile's law would keep without pressure "
    "feedback (`damping_per_bar`):"
)
HOW: Final = (
    "- *Law.* All laws have the same budget, the profile's `kp_1_s` (the plain PID a quarter of it): the gain "
    "inside the boundary layer, where they are linear. Super-twisting is not even there; its gain depends on the "
    "amplitude, so it is judged at several.\n"
    "- *Phase, gain.* The least margins over all machines; every passage of the unit circle and of the negative "
    "real axis counts, so a swinging load that crosses twice is judged twice.\n"
    "- *Bandwidth.* Where the closed loop of the nominal machine at working reach falls below -3 dB. "
    "Feed-forward, which carries a motion, is not in it.\n"
    "- *Worst machine.* That of the least gain margin."
)


def with_law(profile: Profile, kind: str) -> Profile:
    """The profile with another law on every joint."""
    joints = {
        name: msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, kind=kind))
        for name, spec in profile.joints.items()
    }
    return msgspec.structs.replace(profile, joints=joints)


def undamped(profile: Profile) -> Profile:
    """The profile without pressure feedback."""
    joints = {
        name: msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, damping_per_bar=0.0))
        for name, spec in profile.joints.items()
    }
    return msgspec.structs.replace(profile, joints=joints)


def write(machines: Sequence[tuple[Profile, list[JointStudy], Work]], docs: Path) -> bool:
    """Write the page, ``docs/results/loop-design.json`` and the pictures; returns whether every law holds."""
    folder = docs / "results" / "loop-design"
    e = environment()
    out = [
        "# Loop design", "", INTRODUCTION, "",
        f"Commit `{commit()}`, Python {e['python']}. Needed everywhere: {PHASE_DEG:.0f} deg and {GAIN_DB:.0f} dB. All "
        "numbers: [results/loop-design.json](results/loop-design.json).", "", HOW, "",
    ]  # fmt: skip
    document: dict[str, Any] = {"needed": {"phase_deg": PHASE_DEG, "gain_db": GAIN_DB}, "machines": {}}
    holds = True
    for profile, studies, work in machines:
        laws = {kind: study(with_law(profile, kind), work) for kind in LAWS}
        holds = holds and all(joint.holds for judged in laws.values() for joint in judged)
        laws["undamped"] = study(undamped(profile), work)
        document["machines"][profile.name] = {
            kind: {joint.name: joint.document() for joint in judged} for kind, judged in laws.items()
        }
        driven = [joint for joint in studies if joint.name not in profile.joints]
        if driven:
            document["machines"][profile.name]["carrier"] = {loop.name: loop.document() for loop in driven}
            holds = holds and all(loop.holds for loop in driven)
        own = [joint for joint in studies if joint.name in profile.joints]
        out += [f"## {profile.title}", "", *_own(own), "", LEAST, "", *_laws(laws), ""]
        if profile.carrier is not None:
            out += [CARRIER, "", *_natural(profile.carrier), "", *_own(driven), ""]
        for joint, file in zip(studies, draw(profile.name, studies, folder), strict=True):
            caption = f"{joint.name}: loop gain and phase, and the margins of all machines."
            out += [f"![{caption}](results/loop-design/{file.name})", ""]
    document["reached"] = holds
    (docs / "results").mkdir(parents=True, exist_ok=True)
    (docs / "results" / "loop-design.json").write_text(json.dumps(document, indent=2) + "\n")
    (docs / "loop-design.md").write_text("\n".join(out).rstrip() + "\n")
    return holds


def _own(studies: Sequence[JointStudy]) -> list[str]:
    lines = [
        "| joint | law | kp [1/s] | phase [deg] | gain [dB] | bandwidth [Hz] | worst machine | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for joint in studies:
        law = joint.spec.law
        name = NAMES[law.kind] if law.kind != "pd" or law.kd else "P"
        lines.append(
            f"| {joint.name} | {name} | {law.kp_1_s:.3g} | {joint.phase_deg:.0f} | {joint.gain_db:.1f} | "
            f"{joint.bandwidth_hz:.2f} | {joint.worst} | {'reached' if joint.holds else '**missed**'} |"
        )
    return lines


def _natural(carrier: Carrier) -> list[str]:
    lines = ["| speed [m/s] | natural frequency [rad/s] | damping |", "|---|---|---|"]
    for speed in (0.5 * carrier.cruise_speed_m_s, carrier.cruise_speed_m_s, carrier.speed_limit_m_s):
        w, zeta = natural(carrier, speed)
        lines.append(f"| {speed:.2f} | {w:.2f} | {zeta:.2f} |")
    return lines


def _laws(laws: Mapping[str, Sequence[JointStudy]]) -> list[str]:
    lines = [
        "| joint | " + " | ".join(f"{NAMES[kind]} [deg, dB]" for kind in laws) + " |",
        "|---|" + "---|" * len(laws),
    ]
    for rows in zip(*laws.values(), strict=True):
        cells = [f"{j.phase_deg:.0f}, {j.gain_db:.1f}{'' if j.holds else ' (too little)'}" for j in rows]
        lines.append(f"| {rows[0].name} | " + " | ".join(cells) + " |")
    return lines
