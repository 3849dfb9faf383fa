"""Metrics of the plant experiment with their limits, and the page that shows them."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Metric
from experiments.common.result_page import Section
from experiments.plant.bench import LOG_COUNTS
from experiments.plant.bench import METRICS as SPEED

CONCLUSION: Final = (
    "The simulated crane lifts {single_success} of single logs and {pile3_success} of three-log piles by friction "
    "alone.",
    "Its tip sags {sag_250kg_6m_m} under 250 kg at 6 m, and the carrier turns {turn_deg_m} at full articulation. "
    "Both were fitted: to the order of 100 mm that paper A estimates for its crane without naming load and reach, "
    "and to the 9 deg/m at which paper B's heading settles.",
    "The physics runs at {rtf_crane12} real time for the crane and at {rtf_mission} for the whole forwarder.",
)
INTRODUCTION: Final = (
    "The plant replaces the machine: crane, hydraulics, carrier, logs and CAN nodes. This experiment counts its grasps "
    "and compares it with what is known of real machines; the tests of `sim` compare the same motions with closed-form "
    "physics."
)

RELEASED: Final = "Released at 0.12 rad; zero crossings."
GRASPING: Final = (
    Metric("single_success", "Single log lifted", "%", least=0.98),
    Metric("pile3_success", "Pile of three logs lifted completely", "%", least=0.98),
    Metric("unload_success", "Lifted single log laid into the bunk", "%", "Inside, released and at rest.", least=0.98),
    Metric(
        "yaw90_lifted", "Something lifted with an aim 90 deg wrong", "%", "The same grasp along the log.", most=0.02
    ),
    Metric("off1m_lifted", "Something lifted with an aim 1 m beside the log", "%", "Across its axis.", most=0.02),
    Metric(
        "penetration_max_m",
        "Deepest penetration of a jaw into a log in the good grasps",
        "mm",
        "Largest contact penetration in all single and pile trials.",
        most=5e-3,
    ),
    Metric(
        "log_speed_max_m_s",
        "Highest speed of a log's end or middle in the good grasps",
        "m/s",
        "From the first contact until the log lies in the bunk.",
        most=3.0,
    ),
    Metric("load_cell_error", "Error of the load cell", "%", "Mean absolute, against the true mass after the lift."),
)
STRUCTURE: Final = (
    Metric(
        "sag_250kg_6m_m",
        "Tip sag under 250 kg at 6 m",
        "mm",
        "Load on the hook from 0 to 250 kg with all spools closed; true tip against the tip by encoders.",
        least=0.08,
        most=0.12,
    ),
    Metric("sag_seen_by_encoders_m", "Part of the drop that encoders show", "mm", "The cylinders give way as well."),
    Metric(
        "ring_hz",
        "Frequency of the ringing after a boom stop",
        "Hz",
        "60 % spool, closed at once, empty grapple; zero crossings of the true tip height.",
        least=1.0,
        most=2.0,
    ),
    Metric("ring_zeta", "Damping ratio of that ringing", "", "Decay of its peaks.", least=0.005, most=0.3),
    Metric("ring_pp_m_empty", "First swing of that ringing, peak to peak", "mm"),
    Metric("ring_hz_250kg", "Frequency of that ringing with 250 kg on the hook", "Hz"),
    Metric("pressure_empty_pa", "Holding pressure of the lift cylinder at 6 m, empty", "MPa", "Chamber A."),
    Metric("pressure_200kg_pa", "Holding pressure of the lift cylinder at 6 m with 200 kg", "MPa", "Chamber A."),
    Metric("pressure_rise_200kg", "Rise of the holding pressure with 200 kg", "x", "Their ratio.", least=1.1),
    Metric(
        "shared_mean",
        "Speed of four functions together, as a share of each alone",
        "%",
        "Full spool on slew, lift, tilt and telescope; mean of the four shares.",
        most=0.95,
    ),
    Metric("shared_limited", "Share of that time in which the pump is the limit", "%", "By the plant.", least=0.5),
    Metric("slew_pendulum_hz", "Frequency of the load's swing after a slew stop", "Hz", "A grasped log."),
    Metric("slew_pendulum_rad", "Amplitude of that swing", "deg", "First swing after the stop.", least=0.01),
)
FREE: Final = (
    Metric("hanger_period_s", "Period of the empty grapple's swing about the hanger's hinge", "s", RELEASED),
    Metric("fork_period_s", "Period about the fork's hinge", "s", RELEASED),
    Metric("cylinder_hz", "Natural frequency of the oil spring", "Hz", "Lift cylinder without friction and damping."),
    Metric("turn_deg_m", "Turn per metre at full articulation", "deg/m", "Heading over path length.", 8.1, 9.9),
    Metric("turn_radius_m", "Turning radius at full articulation", "m", "Path length over heading."),
    Metric(
        "brake_swing_rad",
        "Swing of the empty grapple after braking from cruise",
        "deg",
        "Largest angle of the hanging grapple from the vertical.",
        least=0.01,
    ),
)
ENDURANCE: Final = (
    Metric("endurance_s", "Duration of continuous work", "s", "Take a log, lay it down elsewhere, go home, repeat."),
    Metric("endurance_moved", "Cycles that moved the log", "%", least=0.9),
    Metric(
        "endurance_not_finite",
        "Cycles that ended with a value that is not finite",
        "",
        "Joints, speeds, pressures, logs.",
        most=0.0,
    ),
    Metric("endurance_memory_mb", "Growth of memory during this work", "MB", "Resident set, from cycle 4.", most=20.0),
    Metric("endurance_tip_drift_m", "Drift of the tip at home", "mm", "True height, from cycle 4.", most=0.01),
)
STEPS: Final = tuple(
    Metric(f"step_ms_{n}_logs", f"Physics step, logs on the ground: {n}", "ms", "Crane at rest.") for n in LOG_COUNTS
)

SECTIONS: Final = (
    Section(
        "Grasping",
        "A grasp works by friction and shape alone: no constraint is ever made between grapple and log, and the "
        "hydraulics are in the loop. Every trial has new logs. An open-loop driver moves the crane. It knows the "
        "profile and the joint positions that encoders show. It receives the grasp target once, with an error of 4 cm "
        "in x and y and of 4 deg in yaw (one sigma), and once, before unloading, the position of the hanging log. A "
        "log is lifted when it is at least half a metre off the ground one second after the lift.",
        GRASPING,
        (
            ("grasps.png", "Success rates with Wilson 95 % intervals. Values outside the limits are shaded."),
            ("grasp-quality.png", "Every good grasp: penetration, highest speed of a log, load cell."),
        ),
    ),
    Section(
        "Structure and hydraulics",
        "Effects of a real crane that its encoders do not show: the column bends under load, the boom rings after a "
        "stop, the oil carries the load, and one pump feeds every function.",
        STRUCTURE,
        (
            ("sag.png", "Load on the hook at 6 m: sag of the true tip, and pressure of the lift cylinder."),
            ("boom-stop.png", "The boom is raised at 60 % spool and stopped at 1.5 s."),
            ("sharing.png", "Full spool on each function alone and on all four together."),
            ("slew-stop.png", "A grasped log after a slew stop."),
        ),
    ),
    Section(
        "Free motions",
        "The empty grapple, the oil of one cylinder, and the carrier.",
        FREE,
        (
            ("pendulum.png", "The empty grapple after its release."),
            ("cylinder.png", "Oil spring of the lift cylinder."),
            ("turning.png", "Path of the front axle at half and at full articulation."),
            ("braking.png", "Driving off, cruising and braking."),
        ),
    ),
    Section(
        "Energy and endurance",
        "No part gains energy by itself, and nothing drifts.",
        ENDURANCE,
        (
            ("energy.png", "Kinetic energy of the undisturbed machine, and total energy of a falling pile."),
            ("endurance.png", "Memory and tip height at home during the endurance run."),
        ),
    ),
    Section(
        "Speed",
        "Real-time factors are medians over intervals of one simulated second. A value below its limit on a busy host "
        "is inconclusive, not missed.",
        SPEED + STEPS,
        (("cost.png", "Time of a 2.5 ms physics step over the number of logs."),),
    ),
)
METRICS: Final = tuple(m for section in SECTIONS for m in section.metrics)
