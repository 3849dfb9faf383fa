"""What the plant experiment measures: sections of figures with their limits, sentences and pictures for the page."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Figure
from experiments.common.result_page import Section
from experiments.plant.bench import FIGURES as SPEED

MM, PERCENT, MPA, DEG = 1e3, 100.0, 1e-6, 57.29577951308232


SECTIONS: Final = (
    Section(
        "Grasping",
        "A grasp is friction and shape alone: no constraint is ever made between grapple and log, and the hydraulics "
        "are in the loop. Every trial has fresh logs. The driver knows the profile and the joint positions an encoder "
        "shows; it is told once where to grasp, with an aim that is off by 4 cm in x and y and 4 deg in yaw at one "
        "sigma, and once, before it unloads, how the log hangs.",
        (
            Figure("single_success", "A single log is lifted", "%",
                   "Half a metre and more off the ground, a second after the lift.",
                   least=0.98, scale=PERCENT),
            Figure("pile3_success", "A pile of three logs is lifted whole", "%",
                   "All three logs, counted as above.", least=0.98, scale=PERCENT),
            Figure("unload_success", "A lifted log is laid into the bunk and stays there", "%",
                   "Carried to the bunk, lowered, released: inside, released and at rest. Of the lifted single logs.",
                   least=0.98, scale=PERCENT),
            Figure("yaw90_lifted", "Aimed 90 deg wrong, something is lifted", "%",
                   "The same grasp with the grapple along the log instead of across it.", most=0.02, scale=PERCENT),
            Figure("off1m_lifted", "Aimed 1 m beside the log, something is lifted", "%",
                   "The same grasp one metre across the log's axis.", most=0.02, scale=PERCENT),
            Figure("penetration_max_m", "Deepest tong in a log in the good grasps", "mm",
                   "Largest contact penetration over all single and pile trials.", most=5e-3, scale=MM),
            Figure("log_speed_max_m_s", "Fastest end or middle of a log in the good grasps", "m/s",
                   "From the first touch until it lies in the bunk.", most=3.0),
            Figure("rest_speed_max_m_s", "Fastest log of those left alone", "mm/s",
                   "A pile on the ground and a load in the bunk, woken and watched for a minute.", most=5e-3,
                   scale=MM),
            Figure("rest_awake_speed_m_s", "The same when the solver may never put them to sleep", "mm/s",
                   "Another minute; contacts that creep or tremble show here.", scale=MM),
            Figure("rest_awake_moved_m", "How far the farthest of them creeps in that minute", "mm",
                   "Distance of its middle.", scale=MM),
            Figure("load_cell_error", "Load cell against the true mass of the logs held", "%",
                   "Mean absolute error at the end of the lift.", scale=PERCENT),
        ),
        (
            ("grasps.png", "Rates with Wilson 95 % intervals; out of bounds is shaded."),
            ("grasp-quality.png", "Every good grasp: penetration, fastest point of a log, load cell."),
        ),
    ),
    Section(
        "Structure and oil",
        "What a real crane does and its encoders do not see: the column bends under load, a stop rings, the oil "
        "carries the load, and one pump feeds every function.",
        (
            Figure("sag_250kg_6m_m", "Tip sag under 250 kg at 6 m", "mm",
                   "Load on the hook from 0 to 250 kg with all spools shut; true tip against the encoders' tip.",
                   least=0.08, most=0.12, scale=MM),
            Figure("sag_seen_by_encoders_m", "The part of the drop that encoders see", "mm",
                   "The cylinders give way too, and that the encoders show: oil spring and damping orifices.",
                   scale=MM),
            Figure("ring_hz", "A boom stop rings at", "Hz",
                   "60 % spool, shut at once, empty grapple; zero crossings of the true tip height.",
                   least=1.0, most=2.0),
            Figure("ring_zeta", "Damping ratio of that ringing", "", "Decay of its peaks.", least=0.005, most=0.3),
            Figure("ring_pp_m_empty", "Its first swing, peak to peak", "mm", "The same run.", scale=MM),
            Figure("ring_hz_250kg", "The same with 250 kg", "Hz", "The same run with a weight on the hook."),
            Figure("pressure_empty_pa", "Holding pressure of the lift cylinder at 6 m, empty", "MPa",
                   "Chamber A, all spools shut.", scale=MPA),
            Figure("pressure_200kg_pa", "The same with 200 kg", "MPa", "Chamber A.", scale=MPA),
            Figure("pressure_rise_200kg", "Rise of the holding pressure with 200 kg", "x", "Ratio of the two.",
                   least=1.1),
            Figure("static_force_error", "Cylinder force against statics", "%",
                   "pA AA - pB AB against the moment of the hanging masses over the lever arm; worst of six loads.",
                   most=0.05, scale=PERCENT),
            Figure("chamber_min_pa", "Lowest chamber pressure met", "MPa", "Over all cylinders, same run.",
                   least=0.0, scale=MPA),
            Figure("shared_mean", "Speed of four functions together, as share of each alone", "%",
                   "Full spool on slew, lift, tilt and telescope; mean of the four shares.", most=0.95, scale=PERCENT),
            Figure("shared_limited", "Share of that time the pump is the limit", "%", "As the plant reports it.",
                   least=0.5, scale=PERCENT),
            Figure("slew_pendulum_period_error", "Period of the load's swing after a slew stop, against theory", "%",
                   "A grasped log; compound pendulum of all that hangs under the fork's hinge.",
                   most=0.10, scale=PERCENT),
            Figure("slew_pendulum_rad", "Amplitude of that swing", "deg", "First swing after the stop.",
                   least=0.01, scale=DEG),
        ),
        (
            ("sag.png", "Load on the hook at 6 m: sag of the true tip, and the lift cylinder's force against statics."),
            ("boom-stop.png", "The boom raised at 60 % spool and shut at 1.5 s."),
            ("sharing.png", "Full spool on each function alone and on all four together."),
            ("slew-stop.png", "A grasped log after a slew stop, with the period of the compound pendulum."),
        ),
    ),
    Section(
        "Closed-form answers",
        "Free-running parts of the plant whose behaviour is known on paper.",
        (
            Figure("pendulum_period_error", "Period of the empty grapple's free swing, worse of both hinges", "%",
                   "Let go at 0.12 rad; compound pendulum from masses and inertias.", most=0.05, scale=PERCENT),
            Figure("pendulum_damping_error", "Its damping ratio, worse of both hinges", "%",
                   "Decay of the peaks against c / (2 I w).", most=0.15, scale=PERCENT),
            Figure("cylinder_hz_error", "Natural frequency of the oil spring", "%",
                   "Lift cylinder without friction and damping against an inertia; beta r^2 (AA^2/VA + AB^2/VB) / I.",
                   most=0.05, scale=PERCENT),
            Figure("cylinder_hz", "That frequency", "Hz", "The same run."),
            Figure("turn_radius_error", "Turning circle of the articulated carrier, worst of radius and deg/m", "%",
                   "Circle through the front axle's path at half and full articulation; (lf cos g + lr) / sin g.",
                   most=0.05, scale=PERCENT),
            Figure("turn_deg_m", "Turn per metre at full articulation", "deg/m", "Heading over path."),
            Figure("turn_radius_m", "Turning radius at full articulation", "m", "The fitted circle."),
            Figure("weight_error", "Sum of the wheel loads against the weight", "%", "Standing.", most=0.01,
                   scale=PERCENT),
            Figure("cruise_speed_error", "Cruising speed against the asked one", "%", "Straight ahead.", most=0.05,
                   scale=PERCENT),
            Figure("parked_creep_m", "Creep while parked", "mm", "Parking brake, 10 s.", most=5e-3, scale=MM),
            Figure("brake_swing_rad", "Swing of the empty grapple after braking from cruise", "deg",
                   "Largest angle of the hanging grapple from the vertical.", least=0.01, scale=DEG),
        ),
        (
            ("pendulum.png", "The empty grapple let go; the dashed envelope is the closed form."),
            ("cylinder.png", "The lift cylinder's oil spring."),
            ("turning.png", "Path of the front axle and the closed-form circle."),
            ("braking.png", "Driving off, cruising and braking."),
        ),
    ),
    Section(
        "Energy and endurance",
        "Nothing gains energy by itself, nothing drifts, and the same seed gives the same bytes.",
        (
            Figure("kinetic_growth", "Growth of the kinetic energy's peaks after everything is shut", "x",
                   "Three functions at full spool, then neutral; a 2 s window's peak over the one before, at most.",
                   most=1.0),
            Figure("falling_energy_created", "Energy created by a falling pile, share of its fall", "%",
                   "Four logs fall 0.6 m; largest rise of kinetic plus potential energy.", most=0.01, scale=PERCENT),
            Figure("lift_efficiency", "Height gained for the pump's energy", "%",
                   "A grasped log raised by the boom; potential energy gained over pump work.", least=0.0, most=0.9,
                   scale=PERCENT),
            Figure("oil_energy_balance", "The oil's account: pump against work, losses and storage", "%",
                   "The same run.", most=0.02, scale=PERCENT),
            Figure("endurance_s", "Work without a pause", "s", "Take a log, lay it down elsewhere, go home; again."),
            Figure("endurance_moved", "Cycles that moved the log", "%", "The same run.", least=0.9, scale=PERCENT),
            Figure("endurance_not_finite", "Cycles that ended with something that is no number", "",
                   "Joints, speeds, pressures, logs.", most=0.0),
            Figure("endurance_memory_mb", "Memory gained over it", "MB", "Resident set, after three cycles.",
                   most=20.0),
            Figure("endurance_tip_drift_m", "Drift of the tip at home", "mm",
                   "True tip height at the end of every cycle against the fourth.", most=0.01, scale=MM),
            Figure("repeat_equal", "Same seed, same bytes in two processes", "",
                   "SHA-256 over all joints, pressures and logs at every step of a grasp; 1 is equal.", least=1.0),
        ),
        (
            ("energy.png", "Kinetic energy of the machine left alone, and total energy of a falling pile."),
            ("endurance.png", "Memory and tip height at home over the shift."),
        ),
    ),
    Section(
        "Speed",
        "Real-time factors are medians over stretches of one simulated second. A figure that a busy host pushes below "
        "its limit is called inconclusive, not missed.",
        (*SPEED,
         Figure("step_ms_1_logs", "Physics step with 1 log", "ms", "Standing crane, logs on the ground."),
         Figure("step_ms_12_logs", "with 12 logs", "ms", "The same."),
         Figure("step_ms_50_logs", "with 50 logs", "ms", "The same."),
         Figure("step_ms_200_logs", "with 200 logs", "ms", "The same.")),
        (("cost.png", "Cost of a 2.5 ms physics step over the number of logs."),),
    ),
)  # fmt: skip
FIGURES: Final = tuple(f for section in SECTIONS for f in section.figures)
PAPER: Final = {"sag_250kg_6m_m": 0.1, "turn_deg_m": 9.0}
"""Paper A: crane flexibility of the order of 0.1 m.  Paper B: steering settles at about 9 deg per metre."""
