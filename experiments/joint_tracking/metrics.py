"""Metrics of the joint-tracking experiment with their limits, tables of all laws, and the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from experiments.common.result import Metric
from experiments.common.result_page import Section
from experiments.joint_tracking.trial import DIVERGED_M

MM, PERCENT, KILO = 1e3, 100.0, 1e-3
MACHINES: Final = {"palms": "palms_471", "aoro": "aoro_fc8"}
LAWS: Final = {
    "pd": "PD",
    "pid": "PID",
    "sliding_mode": "sliding mode",
    "sliding_mode_pe": "sliding mode, estimating",
    "super_twisting": "super-twisting",
    "pd_plain": "plain PD (paper A)",
}
BASELINES: Final = ("pd", "pid", "pd_plain")
SLIDING: Final = "sliding_mode_pe"
MOST_RATIO: Final = {"matched": ("Changed since calibration", 0.7), "cycle": ("As calibrated", 1.0)}
"""The sliding mode's tracking error over that of the best PD or PID law, at most."""
MOST_CHATTER: Final = 1.05
REST_M: Final = 0.010
SHUT: Final = 0.95
STOPS: Final = {
    "lift_empty": "boom, empty",
    "lift_loaded": "boom, loaded",
    "slew_empty": "slew, empty",
    "slew_loaded": "slew, loaded",
}
ROWS: Final = (
    ("Cycle, calibrated: tracking error, RMS", "mm", "calibrated_cycle_tip_rms_m", MM),
    ("Cycle, calibrated: largest tracking error", "mm", "calibrated_cycle_tip_peak_m", MM),
    ("Cycle, calibrated: error at rest, mean", "mm", "calibrated_cycle_rest_m", MM),
    ("Cycle, calibrated: error at rest, worst", "mm", "calibrated_cycle_rest_m_max", MM),
    ("Cycle, calibrated: settling time to 15 mm", "s", "calibrated_cycle_settle_s", 1.0),
    ("Cycle, calibrated: chatter (spool travel)", "%/s", "calibrated_cycle_chatter_pct_s", 1.0),
    ("Cycle, calibrated: pressure ripple", "bar", "calibrated_cycle_ripple_bar", 1.0),
    ("Cycle, calibrated: pump energy", "kJ", "calibrated_cycle_energy_j", KILO),
    ("Cycle, as shipped: tracking error, RMS", "mm", "shipped_cycle_tip_rms_m", MM),
    ("Cycle, as shipped: error at rest, mean", "mm", "shipped_cycle_rest_m", MM),
    ("Cycle, as shipped: settling time to 15 mm", "s", "shipped_cycle_settle_s", 1.0),
    ("Steps: overshoot", "%", "calibrated_steps_overshoot", PERCENT),
    ("Steps: settling time to 10 %", "s", "calibrated_steps_settling_s", 1.0),
    ("Changed since calibration: tracking error, RMS", "mm", "calibrated_matched_tip_rms_m", MM),
    ("Changed since calibration: largest tracking error", "mm", "calibrated_matched_tip_peak_m", MM),
    ("Changed since calibration: chatter (spool travel)", "%/s", "calibrated_matched_chatter_pct_s", 1.0),
    ("Ramps: tracking error, RMS", "mrad or mm", "calibrated_ramps_rms", MM),
    ("Ramps: chatter", "%/s", "calibrated_ramps_chatter_pct_s", 1.0),
    ("Load pick-up: largest error", "mm", "calibrated_pick_up_tip_peak_m", MM),
    ("Load pick-up: error at rest", "mm", "calibrated_pick_up_rest_m", MM),
    ("Pump at its limit: tracking error, RMS", "mm", "calibrated_pump_tip_rms_m", MM),
    ("Pump at its limit: delay of the slowed trajectory", "s", "calibrated_pump_behind_s", 1.0),
    ("Supply pressure lost for one second: largest error", "mm", "calibrated_dip_tip_peak_m", MM),
    ("Supply pressure lost: settling time to 15 mm", "s", "calibrated_dip_settle_s", 1.0),
    ("Supply pressure lost: error at rest", "mm", "calibrated_dip_rest_m", MM),
    ("Twice the spread, calibrated: tracking error, RMS", "mm", "calibrated_wide_tip_rms_m", MM),
    ("Twice the spread, as shipped: tracking error, RMS", "mm", "shipped_wide_tip_rms_m", MM),
    ("Twice the spread, as shipped: settling time to 15 mm", "s", "shipped_wide_settle_s", 1.0),
    ("Corner of twice the spread, calibrated: largest oscillation", "mm", "calibrated_corner_wobble_m_max", MM),
    ("Corner of twice the spread, as shipped: largest oscillation", "mm", "shipped_corner_wobble_m_max", MM),
    ("Corner of twice the spread, as shipped: worst error at rest", "mm", "shipped_corner_rest_m_max", MM),
    ("Corner of twice the spread, as shipped: settling time to 15 mm", "s", "shipped_corner_settle_s", 1.0),
    ("Valves closed after settling, calibrated, all motions", "%", "calibrated_shut_share", PERCENT),
    ("Valves closed after settling, as shipped, all motions", "%", "shipped_shut_share", PERCENT),
)
"""Rows of the table of laws: title, unit, metric name after machine and law, scale."""


def _machine(short: str, law: str) -> tuple[Metric, ...]:
    """Define the metrics of one machine: those of the law in its profile, and those of every law."""
    calibrated, shipped = f"{short}_{law}_calibrated", f"{short}_{law}_shipped"
    own = (
        Metric(
            f"{calibrated}_cycle_rest_m",
            "Error of the tip at rest, mean",
            "mm",
            "Distance of the tip from its goal by the true joint positions, last half second before the next "
            "motion; mean over the ends of all cycles with the law of the profile.",
            most=REST_M,
        ),
        Metric(f"{calibrated}_cycle_rest_m_max", "Error of the tip at rest, worst", "mm", "The same ends."),
        Metric(f"{calibrated}_cycle_settle_s", "Settling time to 15 mm", "s", "After the end of a motion, mean."),
        Metric(
            f"{shipped}_cycle_rest_m",
            "As shipped: error of the tip at rest, mean",
            "mm",
            "The same with the valves that the shipped profile assumes, on individual machines.",
        ),
        Metric(
            f"{shipped}_cycle_alarms",
            "As shipped: false alarms of the motion monitors",
            "joints",
            "All cycles.",
            most=0.0,
        ),
    )
    every = []
    for kind, (title, most) in MOST_RATIO.items():
        over = "of the estimating sliding mode over that of the best PD or PID law"
        every += [
            Metric(f"{short}_{kind}_rms_ratio", f"{title}: error {over}", "", "RMS of the tip, all trials.", most=most),
            Metric(f"{short}_{kind}_chatter_ratio", f"{title}: chatter {over}", "", "The same law.", most=MOST_CHATTER),
        ]
    for name, title in LAWS.items():
        every.append(
            Metric(
                f"{short}_{name}_twice_diverged",
                f"{title}: diverged with twice the spread of delay and gain",
                "machines",
                "Random individuals and all corners of the bounds, empty and loaded, calibrated and as "
                f"shipped. A tip has diverged if it oscillates by {DIVERGED_M} m, or rests that far off and no "
                "nearer than at the end of the motion.",
                most=0.0,
            )
        )
        for state in ("calibrated", "shipped"):
            every.append(
                Metric(
                    f"{short}_{name}_{state}_shut_share",
                    f"{title}, {state}: valves closed after settling",
                    "%",
                    "Share of ticks in which a valve of the arm gets no command, from 2 s after the end of a motion "
                    "(or from when the tip stays within 15 mm, if later) to the next motion; mean over all motions "
                    "that settle.",
                    least=None if name == "pd_plain" else SHUT,
                )
            )
            every.append(
                Metric(
                    f"{short}_{name}_{state}_unsettled_share",
                    f"{title}, {state}: motions that do not settle",
                    "%",
                    "The tip does not stay within 15 mm until the next motion begins, 7 to 9 s later.",
                )
            )
    return own + tuple(every)


def table(short: str, metrics: Mapping[str, float]) -> str:
    """Write all laws on the same machines and motions as a Markdown table; the best value of each row is bold."""
    lines = ["", "| | unit | " + " | ".join(LAWS.values()) + " |", "|---|---|" + "---|" * len(LAWS)]
    for title, unit, key, scale in ROWS:
        values = [scale * metrics.get(f"{short}_{law}_{key}", math.nan) for law in LAWS]
        if any(math.isnan(v) for v in values):
            continue
        best = max(values) if key.endswith("shut_share") else min(values)
        cells = [f"**{v:.3g}**" if v == best else f"{v:.3g}" for v in values]
        lines.append(f"| {title} | {unit} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def best_laws(short: str, law: str, metrics: Mapping[str, float]) -> str:
    """Name the law in the profile, and in how many rows of the table each law is best."""
    wins = dict.fromkeys(LAWS, 0)
    for _, _, key, _ in ROWS:
        values = {name: metrics.get(f"{short}_{name}_{key}", math.nan) for name in LAWS}
        if not any(math.isnan(v) for v in values.values()):
            best = (max if key.endswith("shut_share") else min)(values.values())
            winners = [name for name in LAWS if values[name] == best]
            if len(winners) == 1:
                wins[winners[0]] += 1
    counts = ", ".join(f"{title} {wins[name]}" for name, title in LAWS.items())
    return f"The profile uses {LAWS[law]}. Number of rows in which each law alone is best: {counts}."


def damping(short: str, metrics: Mapping[str, float]) -> str:
    """Write the ringing after a stop without and with pressure feedback as a Markdown table."""
    lines = [
        "",
        "| stop of | pin rings without [mm] | with [mm] | change | pressure rings without [bar] | with [bar] | change "
        "|",
        "|---|---|---|---|---|---|---|",
    ]
    for key, title in STOPS.items():
        cells = []
        for quantity, scale in (("ring_m", MM), ("ripple_bar", 1.0)):
            plain, damped = (
                metrics.get(f"{short}_stop_{key}_{how}_{quantity}", math.nan) for how in ("plain", "damped")
            )
            cells += [f"{scale * plain:.2f}", f"{scale * damped:.2f}", f"{PERCENT * (damped / plain - 1.0):+.0f} %"]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _both(laws: Mapping[str, str], made: dict[str, str]) -> str:
    return "\n\n".join(f"**{MACHINES.get(short, short)}**\n{made[short]}" for short in laws)


def conclusion(laws: Mapping[str, str]) -> tuple[str, ...]:
    """Return the templates of the conclusion; ``laws``: the law of each machine's profile, by its short name."""
    rests = ", ".join(
        f"on `{MACHINES[short]}` {{{short}_{law}_calibrated_cycle_rest_m}} from its goal" for short, law in laws.items()
    )
    return (f"With the law of its profile and calibrated valves, the tip comes to rest {rests} on average.",)


def sections(laws: Mapping[str, str], metrics: Mapping[str, float]) -> tuple[Section, ...]:
    """Make the sections of the page; ``laws``: the law of each machine's profile, by its short name."""

    def machine(short: str, text: str) -> str:
        return f"{text} {best_laws(short, laws[short], metrics)}\n{table(short, metrics)}\n\nMetrics with limits:"

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
                "Paper B names sliding mode control and cites La Hera and Ortiz Morales 2015. Its equations were not "
                "available, so the law here is a reconstruction. This crane is heavier and longer than the PALMS, and "
                "its oil is softer.",
            ),
            _machine("aoro", laws["aoro"]),
            (
                ("aoro.png", "All laws on the same machines: calibrated (dark) and as shipped (light)."),
                ("traces.png", "One cycle with each law: error of the tip and spool command of the slew."),
                ("wide.png", "Every machine with twice the spread, calibrated (dark) and as shipped (light)."),
            ),
        ),
        Section(
            "Vibration damping by pressure feedback",
            DAMPING
            + "\n\n"
            + _both(laws, {short: damping(short, metrics) for short in laws})
            + "\n\nSum of all stops:",
            tuple(
                Metric(
                    f"{short}_stop_damped_over_plain",
                    f"{MACHINES[short]}: ringing with pressure feedback over without, all stops",
                    "",
                    "RMS of the pin's motion faster than 1 s, 0.25 to 2.5 s after the stop: vertical for the boom, "
                    "lateral for the slew; sums over all stops.",
                )
                for short in laws
            ),
            (("stop.png", "Ringing of the pin after a stop of the loaded AORO, without and with pressure feedback."),),
        ),
    )


DAMPING: Final = (
    "The swinging load and the compliant column ring after a stop. The ringing shows in the load pressure, and the law "
    "yields to it (`damping_per_bar`; paper B attenuates residual vibrations in this way). Boom and slew stop from 80 "
    "% of their speed with full deceleration, in both directions, on each individual, with and without this feedback. "
    "It brings no gain after a stop, and a slew may ring more with it than without: the valve answers 80 to 190 ms "
    "late, a third of the ringing's period or more, and once a joint rests, its valve is closed and nothing is damped. "
    "Pressures with a lead of that time damped no better. The feedback is on by default for another reason: while the "
    "law holds the joint, the linear model of a loaded slew or boom does not keep its margins at these gains without "
    "it ([loop-design.md](loop-design.md), last column)."
)
INTRODUCTION: Final = (
    "Six joint laws run on the same individual machines, motions and disturbances. All but the plain PD have "
    "feed-forward, delay compensation, pressure damping, a stop band and an inverse of the valve's dead-band, "
    "metering curve and play, and share one budget of gain, so that the same phase and gain margins hold for all: "
    "[loop-design.md](loop-design.md). The plain PD is paper A's, without a lead of the feed-forward, delay "
    "compensation and damping; the paper gives neither rate nor gain, so 50 Hz is assumed, and the quarter of the "
    "gain that its margins leave. Behind a dead time a switching term has no more gain than a PD law, so the "
    "estimating sliding mode learns the gain of each valve, from the commands that arrive and the travel that they "
    "make (Elmali and Olgac 1992, sliding mode control with perturbation estimation). *Changed since calibration* is "
    "what it is for: all valves give 30 % less or more, the oil is cold (15 % less, dead times 30 % longer), or a "
    "load hangs on the hook or the supply lacks 60 % of its pressure for half of each motion. Every trial uses "
    "another individual machine drawn from the truth's spread, "
    'with dead times of 40 to 150 ms and gains and dead-bands up to 20 % off. "Calibrated" means that the profile '
    "holds the valves of that machine within the accuracy of a calibration. A cycle is the quasi-parabolic motion of "
    "a crane between trail and bunk, there and back, with all joints together at 45 % of their speed limits."
)
