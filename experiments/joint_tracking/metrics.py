"""What the joint-tracking experiment reports: figures with their limits, tables of all laws, sections of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from experiments.common.result import Figure
from experiments.common.result_page import Section
from experiments.joint_tracking.trial import DIVERGED_M

MM, PERCENT, KILO = 1e3, 100.0, 1e-3
MACHINES: Final = {"palms": "palms_471", "aoro": "aoro_fc8"}
LAWS: Final = {"pd": "PD", "sliding_mode": "sliding mode", "super_twisting": "super-twisting", "pid": "plain PID"}
REST_M: Final = 0.010
SHUT: Final = 0.95
STOPS: Final = {
    "lift_empty": "boom, empty",
    "lift_loaded": "boom, loaded",
    "slew_empty": "slew, empty",
    "slew_loaded": "slew, loaded",
}
ROWS: Final = (
    ("Cycle, calibrated: error on the way, rms", "mm", "calibrated_cycle_tip_rms_m", MM),
    ("its greatest", "mm", "calibrated_cycle_tip_peak_m", MM),
    ("where the tip rests, mean", "mm", "calibrated_cycle_rest_m", MM),
    ("the worst rest", "mm", "calibrated_cycle_rest_m_max", MM),
    ("settled within 15 mm", "s", "calibrated_cycle_settle_s", 1.0),
    ("chatter: way of the spools", "%/s", "calibrated_cycle_chatter_pct_s", 1.0),
    ("pressure ripple", "bar", "calibrated_cycle_ripple_bar", 1.0),
    ("energy from the pump", "kJ", "calibrated_cycle_energy_j", KILO),
    ("Cycle, as shipped: error on the way, rms", "mm", "shipped_cycle_tip_rms_m", MM),
    ("where the tip rests, mean", "mm", "shipped_cycle_rest_m", MM),
    ("settled within 15 mm", "s", "shipped_cycle_settle_s", 1.0),
    ("Steps: overshoot", "%", "calibrated_steps_overshoot", PERCENT),
    ("settled within 10 %", "s", "calibrated_steps_settling_s", 1.0),
    ("Ramps: error on the way, rms", "mrad or mm", "calibrated_ramps_rms", MM),
    ("chatter", "%/s", "calibrated_ramps_chatter_pct_s", 1.0),
    ("Load pick-up: greatest error", "mm", "calibrated_pick_up_tip_peak_m", MM),
    ("where the tip rests", "mm", "calibrated_pick_up_rest_m", MM),
    ("More oil than the pump gives: error on the way, rms", "mm", "calibrated_pump_tip_rms_m", MM),
    ("how far its slowed time falls behind", "s", "calibrated_pump_behind_s", 1.0),
    ("Supply breaks down for a second: greatest error", "mm", "calibrated_dip_tip_peak_m", MM),
    ("settled within 15 mm", "s", "calibrated_dip_settle_s", 1.0),
    ("where the tip rests", "mm", "calibrated_dip_rest_m", MM),
    ("Twice the spread, calibrated: error on the way, rms", "mm", "calibrated_wide_tip_rms_m", MM),
    ("Twice the spread, as shipped: error on the way, rms", "mm", "shipped_wide_tip_rms_m", MM),
    ("settled within 15 mm", "s", "shipped_wide_settle_s", 1.0),
    ("All joints in a corner of it, calibrated: worst wobble", "mm", "calibrated_corner_wobble_m_max", MM),
    ("as shipped: worst wobble", "mm", "shipped_corner_wobble_m_max", MM),
    ("as shipped: worst rest", "mm", "shipped_corner_rest_m_max", MM),
    ("as shipped: settled within 15 mm", "s", "shipped_corner_settle_s", 1.0),
    ("Valves shut after settling, calibrated, all motions", "%", "calibrated_shut_share", PERCENT),
    ("as shipped, all motions", "%", "shipped_shut_share", PERCENT),
)
"""Rows of the table of laws: what, unit, metric behind machine and law, scale."""


def _machine(short: str, law: str) -> tuple[Figure, ...]:
    """Figures of one machine: those of its profile's law, and what holds for every law."""
    mine, raw = f"{short}_{law}_calibrated", f"{short}_{law}_shipped"
    own = (
        Figure(f"{mine}_cycle_rest_m", "Where the tip rests, mean", "mm",
               "Distance of the tip from its goal by the joints' true positions, last half second before the next "
               "motion; mean over the ends of all cycles with the profile's law.", most=REST_M, scale=MM),
        Figure(f"{mine}_cycle_rest_m_max", "The same, worst", "mm", "The same ends.", scale=MM),
        Figure(f"{mine}_cycle_settle_s", "Settled within 15 mm", "s", "After the end of a motion, mean."),
        Figure(f"{raw}_cycle_rest_m", "As shipped: where the tip rests, mean", "mm",
               "The same with the profile's assumed valves on individuals that differ by the spread.", scale=MM),
        Figure(f"{raw}_cycle_alarms", "As shipped: false alarms of the motion monitors", "joints",
               "Over all cycles.", most=0.0),
    )  # fmt: skip
    every = []
    for name, title in LAWS.items():
        every.append(
            Figure(f"{short}_{name}_twice_diverged", f"{title}: diverged with twice the spread of delay and gain",
                   "machines", "Random individuals and all corners of the bounds, empty and loaded, calibrated and as "
                   f"shipped; diverged is a tip that wobbles by {DIVERGED_M} m, or rests that far off and no nearer "
                   "than where the motion left it.", most=0.0)
        )  # fmt: skip
        for state in ("calibrated", "shipped"):
            every.append(
                Figure(f"{short}_{name}_{state}_shut_share", f"{title}, {state}: valves shut after settling", "%",
                       "Ticks in which a valve of the arm gets no command, from 2 s after the end of a motion or from "
                       "when the tip is within 15 mm for good, whichever is later, to the next motion; mean over all "
                       "motions of the tip that settle.", least=None if name == "pid" else SHUT, scale=PERCENT)
            )  # fmt: skip
            every.append(
                Figure(f"{short}_{name}_{state}_unsettled_share", f"{title}, {state}: motions that do not settle", "%",
                       "The tip is not within 15 mm for good when the next motion begins, 7 to 9 s later.",
                       scale=PERCENT)
            )  # fmt: skip
    return own + tuple(every)


def table(short: str, metrics: Mapping[str, float]) -> str:
    """All laws on the same machines and motions, as Markdown; the best of each row is bold."""
    lines = ["", "| | unit | " + " | ".join(LAWS.values()) + " |", "|---|---|" + "---|" * len(LAWS)]
    for title, unit, key, scale in ROWS:
        values = [scale * metrics.get(f"{short}_{law}_{key}", math.nan) for law in LAWS]
        if any(math.isnan(v) for v in values):
            continue
        best = max(values) if key.endswith("shut_share") else min(values)
        cells = [f"**{v:.3g}**" if v == best else f"{v:.3g}" for v in values]
        lines.append(f"| {title} | {unit} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def verdict(short: str, law: str, metrics: Mapping[str, float]) -> str:
    """Which law wins how many rows, and what the profile names."""
    wins = dict.fromkeys(LAWS, 0)
    for _, _, key, _ in ROWS:
        values = {name: metrics.get(f"{short}_{name}_{key}", math.nan) for name in LAWS}
        if not any(math.isnan(v) for v in values.values()):
            wins[(max if key.endswith("shut_share") else min)(values, key=lambda n: values[n])] += 1
    told = ", ".join(f"{title} {wins[name]}" for name, title in LAWS.items())
    return f"The profile names {LAWS[law]}. Rows in which a law is best: {told}."


def damping(short: str, metrics: Mapping[str, float]) -> str:
    """Ringing after a stop without and with pressure feedback, as Markdown."""
    lines = [
        "",
        "| stop of | rings without [mm] | with [mm] | change | pressure rings without [bar] | with [bar] | change |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, title in STOPS.items():
        cells = []
        for what, scale in (("ring_m", MM), ("ripple_bar", 1.0)):
            plain, damped = (metrics.get(f"{short}_stop_{key}_{how}_{what}", math.nan) for how in ("plain", "damped"))
            cells += [f"{scale * plain:.2f}", f"{scale * damped:.2f}", f"{PERCENT * (damped / plain - 1.0):+.0f} %"]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _both(laws: Mapping[str, str], made: dict[str, str]) -> str:
    return "\n\n".join(f"**{MACHINES.get(short, short)}**\n{made[short]}" for short in laws)


def sections(laws: Mapping[str, str], metrics: Mapping[str, float]) -> tuple[Section, ...]:
    """``laws``: the law of each machine's profile, by its short name."""

    def machine(short: str, text: str) -> str:
        return f"{text} {verdict(short, laws[short], metrics)}\n{table(short, metrics)}\n\nWhat must hold:"

    return (
        Section(
            "PALMS 4.71",
            machine("palms", "Paper A's PLC runs a PD law on this machine."),
            _machine("palms", laws["palms"]),
            (("palms.png", "All laws on the same machines: calibrated (dark) and as shipped (light)."),),
        ),
        Section(
            "AORO with FC8",
            machine(
                "aoro",
                "Paper B names sliding mode control and cites La Hera and Ortiz Morales 2015; what runs here is a "
                "reconstruction, for its equations were not at hand. Heavier, longer and on softer oil than the small "
                "crane.",
            ),
            _machine("aoro", laws["aoro"]),
            (
                ("aoro.png", "All laws on the same machines: calibrated (dark) and as shipped (light)."),
                ("traces.png", "One cycle with each law: error of the tip and spool command of the slew."),
                ("wide.png", "Every machine of twice the spread, calibrated (dark) and as shipped (light)."),
            ),
        ),
        Section("Vibration damping by pressure feedback", DAMPING + "\n\n" + _both(
            laws, {short: damping(short, metrics) for short in laws}) + "\n\nTogether:", tuple(
            Figure(f"{short}_stop_damped_over_plain", f"{MACHINES[short]}: ringing with over without, all stops",
                   "", "Root mean square of what the pin does faster than 1 s, 0.25 to 2.5 s after the stop: up and "
                   "down for the boom, across for the slew; sums over all stops.")
            for short in laws
        ), (("stop.png", "A loaded AORO stops: how its pin rings, without and with pressure feedback."),)),
    )  # fmt: skip


DAMPING: Final = (
    "What rings after a stop, the swinging load and the column that gives way, shows in the load pressure; the "
    "law gives way to it (`damping_per_bar`; paper B attenuates residual vibrations so). Boom and slew stop from "
    "80 % of their speed as hard as their acceleration limit allows, both ways, on each individual, with and "
    "without. After a stop it is no gain, and a slew may ring more with it than without (below): the valve answers "
    "80 to 190 ms late, a third of a period of the ringing and more, and once a joint rests its valve is shut and "
    "nothing is damped any more; pressures led by that time damped no better. It is on by default for another "
    "reason: while the law holds the joint, the linear model of a loaded slew or boom does not keep its margins at "
    "these gains without it ([loop-design.md](loop-design.md), last column)."
)
INTRODUCTION: Final = (
    "Four joint laws on the same individual machines, motions and disturbances: PD (paper A), sliding mode with a "
    "boundary layer and super-twisting (paper B), each with feed-forward, delay compensation, pressure damping, "
    "stop band and an inverse of the valve's dead-band, metering curve and play, and a plain PID without "
    "feed-forward, delay compensation and damping as the baseline. The profile's gain is the budget of every law "
    "(the PID gets a quarter of it, or its margins would not hold), so the same phase and gain margins hold for "
    "all: [loop-design.md](loop-design.md). Every trial is another individual machine drawn from the truth's "
    "spread: dead times 40 to 150 ms, gains and dead-bands up to 20 % off. Calibrated means that the profile has "
    "that machine's valves within the accuracy of a calibration. A cycle is the quasi-parabolic motion of a crane "
    "between trail and bunk, there and back, with all joints together at 45 % of their speed limits. `timberhand "
    "experiment joint-tracking --docs docs` measures everything and writes this page; no number is typed."
)
