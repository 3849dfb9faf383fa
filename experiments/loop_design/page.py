"""The page docs/loop-design.md: conclusion and one plot, then margins of every joint, law and machine.

Input: the studies of all machines, or the saved ``docs/results/loop-design.json``.  Output: Markdown, JSON and plots.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from controller.laws.feedback import LAWS
from experiments.common.result import commit, environment
from experiments.loop_design.carrier import natural
from experiments.loop_design.loop import FREQUENCY_RAD_S
from experiments.loop_design.study import MIN_GAIN_DB, MIN_PHASE_DEG, CaseSet, JointStudy, study
from machine.loading.profile_file import load_profile
from machine.profile import Carrier, Profile
from runtime.plot_style import OIL, RUST, STEEL, sheet

NAMES: Final = {
    "pd": "PD",
    "sliding_mode": "sliding mode",
    "sliding_mode_pe": "sliding mode, estimating",
    "super_twisting": "super-twisting",
    "pid": "PID",
    "pd_plain": "plain PD (paper A)",
    "undamped": "own law without pressure feedback",
}
INTRODUCTION: Final = (
    "The loop of each joint is a linear model: the true valve (dead time, second-order spool, gain), the mechanics "
    "that it drives (oil springs, inertia, the hanging load as a pendulum, the compliant column), the encoder, and the "
    "controller as it runs: sampled, with the estimator's Kalman gains, delay compensation and pressure feedback, cut "
    "at the velocity command. The mechanics are linearized from the physics at near, working and far reach, empty and "
    "loaded, in both directions, with the valve slightly and widely open; dead times and gains cover the whole spread "
    "of the truth. The controller knows only the profile. Tests excite the running code with sines and compare it with "
    "these responses, and python-control computes the margins of the worst loop again. `timberhand bench loop-design "
    "--docs docs` computes everything and writes this page."
)
CARRIER: Final = (
    "The loops of the carrier (docs/reference/machines.md sections 7.2, 7.3). *heading* is paper B's law, from bearing "
    "less heading to the rate of the articulation, at half and full cruising speed, far from the waypoint and near it, "
    "with the latency of the receiver and odometry between its samples. *articulation* controls an angle by the "
    "encoder, *swing arm* a height. Without valve and receiver the heading is L s^2 + Kp lr s + Kp v = 0:"
)
LEAST: Final = (
    "Least margins with every law that a profile may use, and with the profile's law without pressure feedback "
    "(`damping_per_bar`):"
)
HOW: Final = (
    "- *Law*: all laws use the gain `kp_1_s` of the profile (the plain PD a quarter of it, the estimating sliding mode "
    "three quarters) inside their boundary layer, where they are linear. Super-twisting is nonlinear there as well; "
    "its gain depends on the amplitude, so several amplitudes are evaluated. The estimate of a valve's gain is slower "
    "than the loop and brings its gain back to the profile's; the margins are those without it.\n"
    "- *Phase, gain*: the least margins over all machines. Every crossing of the unit circle and of the negative real "
    "axis counts, so a loop that a swinging load makes cross twice is evaluated twice.\n"
    "- *Bandwidth*: frequency at which the closed loop of the nominal machine at working reach falls below -3 dB. "
    "Feed-forward, which moves the joint, is not included.\n"
    "- *Worst machine*: that of the least gain margin."
)


def with_law(profile: Profile, kind: str) -> Profile:
    """Give every joint of the profile another law."""
    joints = {
        name: msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, kind=kind))
        for name, spec in profile.joints.items()
    }
    return msgspec.structs.replace(profile, joints=joints)


def undamped(profile: Profile) -> Profile:
    """Remove the pressure feedback from the profile."""
    joints = {
        name: msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, damping_per_bar=0.0))
        for name, spec in profile.joints.items()
    }
    return msgspec.structs.replace(profile, joints=joints)


def write(machines: Sequence[tuple[Profile, list[JointStudy], CaseSet]], docs: Path) -> bool:
    """Write the page, ``docs/results/loop-design.json`` and the plots; returns whether every margin meets its limit."""
    document: dict[str, Any] = {
        "commit": commit(),
        "python": environment()["python"],
        "needed": {"phase_deg": MIN_PHASE_DEG, "gain_db": MIN_GAIN_DB},
        "machines": {},
    }
    for profile, studies, cases in machines:
        laws = {kind: study(with_law(profile, kind), cases) for kind in LAWS}
        laws["undamped"] = study(undamped(profile), cases)
        joint_documents = {kind: {joint.name: joint.document() for joint in studied} for kind, studied in laws.items()}
        if loops := {s.name: s.document() for s in studies if s.name not in profile.joints}:
            joint_documents["carrier"] = loops
        document["machines"][profile.name] = joint_documents
        draw(profile.name, studies, docs / "results" / "loop-design")
    document["reached"] = all(loop["holds"] for _, _, loop in _with_limits(document))
    (docs / "results").mkdir(parents=True, exist_ok=True)
    (docs / "results" / "loop-design.json").write_text(json.dumps(document, indent=2) + "\n")
    (docs / "loop-design.md").write_text(markdown(document, [profile for profile, _, _ in machines]))
    return bool(document["reached"])


def rewrite(docs: Path) -> Path:
    """Write the page again from ``docs/results/loop-design.json``, whose machines are shipped profiles; its path.

    Raises:
        ValueError: the file is not a saved study, or names an unknown profile.
    """
    document = json.loads((docs / "results" / "loop-design.json").read_text())
    path = docs / "loop-design.md"
    path.write_text(markdown(document, [load_profile(name) for name in document["machines"]]))
    return path


def markdown(document: Mapping[str, Any], profiles: Sequence[Profile]) -> str:
    """Write the page from the saved numbers."""
    needed = document["needed"]
    plots = {
        profile.name: [_plot(profile.name, name) for name in (*_own(document, profile), *_carrier(document, profile))]
        for profile in profiles
    }
    first = plots[profiles[0].name][0]
    out = [
        "# Loop design",
        "",
        _conclusion(document),
        "",
        first,
        "",
        "## Method",
        "",
        INTRODUCTION,
        "",
        f"Commit `{document['commit']}`, Python {document['python']}. Limits: {needed['phase_deg']:.0f} deg phase "
        f"margin and {needed['gain_db']:.0f} dB gain margin. [results/loop-design.json](results/loop-design.json) "
        "holds all numbers.",
        "",
        HOW,
        "",
    ]
    for profile in profiles:
        own, carrier = _own(document, profile), _carrier(document, profile)
        laws = {kind: joints for kind, joints in document["machines"][profile.name].items() if kind != "carrier"}
        out += [f"## {profile.title}", "", *_table(own), "", LEAST, "", *_laws(laws), ""]
        if profile.carrier is not None and carrier:
            out += [CARRIER, "", *_natural(profile.carrier), "", *_table(carrier, "P"), ""]
        for plot in plots[profile.name]:
            out += [plot, ""] if plot != first else []
    return "\n".join(out).rstrip() + "\n"


def _own(document: Mapping[str, Any], profile: Profile) -> dict[str, Any]:
    """List the joints of a machine with the law of its profile."""
    laws = document["machines"][profile.name]
    return {name: laws[joint["law"]][name] for name, joint in laws["undamped"].items()}


def _carrier(document: Mapping[str, Any], profile: Profile) -> dict[str, Any]:
    loops: dict[str, Any] = document["machines"][profile.name].get("carrier", {})
    return loops


def _with_limits(document: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield machine, joint and numbers of every loop whose margins have limits."""
    for machine, laws in document["machines"].items():
        for kind, joints in laws.items():
            if kind != "undamped":
                yield from ((machine, name, joint) for name, joint in joints.items())


def _conclusion(document: Mapping[str, Any]) -> str:
    loops = list(_with_limits(document))
    phase = min(loops, key=lambda x: x[2]["phase_margin_deg"])
    gain = min(loops, key=lambda x: x[2]["gain_margin_db"])
    met = sum(loop["holds"] for _, _, loop in loops)
    return (
        f"{met} of {len(loops)} loops keep their margins on every machine of the truth's spread, with every law. The "
        f"least phase margin is {phase[2]['phase_margin_deg']:.0f} deg ({phase[1]} of `{phase[0]}`), the least gain "
        f"margin {gain[2]['gain_margin_db']:.1f} dB ({gain[1]} of `{gain[0]}`)."
    )


def _plot(machine: str, name: str) -> str:
    caption = f"{name} of {machine}: loop gain and phase, and the margins of all machines."
    return f"![{caption}](results/loop-design/{plot_name(machine, name)})"


def _table(joints: Mapping[str, Any], law: str = "") -> list[str]:
    """Write the rows of the loops; ``law``: its name, if not that of the saved one."""
    lines = [
        "| joint | law | kp [1/s] | phase [deg] | gain [dB] | bandwidth [Hz] | worst machine | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, joint in joints.items():
        lines.append(
            f"| {name} | {law or NAMES[joint['law']]} | {joint['kp_1_s']:.3g} | {joint['phase_margin_deg']:.0f} | "
            f"{joint['gain_margin_db']:.1f} | {joint['bandwidth_hz']:.2f} | {joint['worst']} | "
            f"{'met' if joint['holds'] else '**missed**'} |"
        )
    return lines


def _natural(carrier: Carrier) -> list[str]:
    lines = ["| speed [m/s] | natural frequency [rad/s] | damping |", "|---|---|---|"]
    for speed in (0.5 * carrier.cruise_speed_m_s, carrier.cruise_speed_m_s, carrier.speed_limit_m_s):
        w, zeta = natural(carrier, speed)
        lines.append(f"| {speed:.2f} | {w:.2f} | {zeta:.2f} |")
    return lines


def _laws(laws: Mapping[str, Mapping[str, Any]]) -> list[str]:
    lines = [
        "| joint | " + " | ".join(f"{NAMES[kind]} [deg, dB]" for kind in laws) + " |",
        "|---|" + "---|" * len(laws),
    ]
    for name in laws["undamped"]:
        rows = [joints[name] for joints in laws.values()]
        cells = [
            f"{j['phase_margin_deg']:.0f}, {j['gain_margin_db']:.1f}{'' if j['holds'] else ' (too little)'}"
            for j in rows
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def plot_name(machine: str, loop: str) -> str:
    """Return the file name of the plot of a loop."""
    return f"{machine}-{loop.replace(' ', '-')}.png"


def draw(machine: str, studies: Sequence[JointStudy], out: Path) -> list[Path]:
    """Write one plot per loop into ``out``; returns the files."""
    files = []
    for joint in studies:
        path = out / plot_name(machine, joint.name)
        with sheet(path, 3, width=11.0, height=3.4) as (gain, phase, cloud):
            hz = FREQUENCY_RAD_S / (2.0 * math.pi)
            for loop, colour, name in ((joint.nominal_loop, OIL, "nominal"), (joint.worst_loop, RUST, "worst")):
                gain.semilogx(hz, 20.0 * np.log10(np.abs(loop)), color=colour, label=name)
                degrees = np.degrees(np.unwrap(np.angle(loop)))
                phase.semilogx(hz, degrees - (360.0 if degrees[0] > 0.0 else 0.0), color=colour)
            gain.axhline(0.0, color=STEEL, lw=0.8)
            gain.set_ylim(-60, 40)
            gain.set_title(f"{joint.name}: loop gain [dB]")
            gain.legend()
            phase.axhline(-180.0, color=STEEL, lw=0.8)
            phase.set_ylim(-540, 0)
            phase.set_title("phase [deg]")
            for axis in (gain, phase):
                axis.set_xlabel("frequency [Hz]")
            delays = [1e3 * case.delay_s for case in joint.cases]
            shown = cloud.scatter(
                [m.phase_deg for m in joint.margins], [m.gain_db for m in joint.margins], c=delays, s=7, cmap="viridis"
            )
            cloud.figure.colorbar(shown, label="dead time [ms]")
            cloud.axvline(MIN_PHASE_DEG, color=RUST, lw=0.8, ls="--")
            cloud.axhline(MIN_GAIN_DB, color=RUST, lw=0.8, ls="--")
            cloud.set_xlabel("phase margin [deg]")
            cloud.set_title("gain margin [dB], all machines")
        files.append(path)
    return files
