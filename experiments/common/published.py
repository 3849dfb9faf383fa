"""What others published, and our figures that answer the same questions: papers A and B, and later systems.

A figure stands as its source prints it.  Where the source says on how many trials, the Wilson interval is derived.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from experiments.common.result import wilson


@dataclass(frozen=True, slots=True)
class Published:
    """A published figure: system, its setting, the share [1] on ``trials`` trials (0: not stated), and the source.

    ``nearest``: experiment and metric of ours that ask the most similar question.
    """

    system: str
    setting: str
    measure: str
    share: float
    trials: int
    source: str
    nearest: tuple[str, str]

    def text(self) -> str:
        """Write the share in percent, with its interval where the number of trials is known."""
        shown = f"{100.0 * self.share:.4g}%"
        if not self.trials:
            return shown
        low, high = wilson(round(self.share * self.trials), self.trials)
        return f"{shown} ({100.0 * low:.1f} to {100.0 * high:.1f}, n = {self.trials})"


LATER: Final = (
    Published(
        "Andersson et al. 2021",
        "simulation; single log, its pose given",
        "logs grasped",
        0.97,
        0,
        "https://arxiv.org/abs/2103.02315",
        ("grasp-configs", "config1.success"),
    ),
    Published(
        "Wallin et al. 2024",
        "simulation; piles of 2 to 5 logs, virtual camera",
        "one or several logs picked",
        0.95,
        0,
        "https://doi.org/10.3390/robotics13010003",
        ("grasp-configs", "success"),
    ),
    Published(
        "Vu et al. 2025",
        "simulation (MuJoCo); single log, diameters and start drawn",
        "logs grasped and lifted",
        0.96,
        0,
        "https://arxiv.org/abs/2502.01304",
        ("grasp-configs", "config1.success"),
    ),
    Published(
        "Kurinov et al. 2026",
        "simulation (Isaac Gym); one log, flat ground, into the bunk",
        "logs delivered",
        0.94,
        1024,
        "https://doi.org/10.24425/ame.2026.158900",
        ("forwarding-mission", "loaded"),
    ),
    Published(
        "Software of the FPInnovations crane 2026",
        "real crane; piles of about 200 logs, heuristic",
        "cycles that lifted logs",
        49 / 73,
        73,
        "https://github.com/george-sideris/crane-hierarchical-rl",
        ("grasp-configs", "first_closing"),
    ),
    Published(
        "Software of the FPInnovations crane 2026",
        "the same; learned scoring, single mound",
        "cycles that lifted logs",
        16 / 23,
        23,
        "https://github.com/george-sideris/crane-hierarchical-rl",
        ("grasp-configs", "first_closing"),
    ),
    Published(
        "Software of the FPInnovations crane 2026",
        "the same; learned scoring, double mound",
        "cycles that lifted logs",
        17 / 30,
        30,
        "https://github.com/george-sideris/crane-hierarchical-rl",
        ("grasp-configs", "first_closing"),
    ),
)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A question that paper A or B answers, and the metrics of one experiment that answer it here.

    ``paper_metric`` is the metric under which a result holds the paper's figure, ``trials`` its number of trials (0:
    not stated, or no rate).  ``method``: by the paper's method here; ``rules``: by ours under the paper's rules;
    ``everything``: by ours with everything that it has; empty where this is not measured.  ``differs`` says what the
    figures do not share, and why the method falls short where it does.
    """

    question: str
    paper: str
    experiment: str
    paper_metric: str
    trials: int
    method: str
    rules: str
    everything: str
    differs: str


CHAIN: Final = (
    "Its chain: masks of our network, its perception as a practitioner reads it, its network trained on 80 of 885 "
    "Cornell pictures. Its rules, which its chain keeps here too: one plan, one closing, one lift; ours with "
    "everything grips again. Rendered pictures here and in the paper's simulator; on its real crane 58 of 60 "
    "succeeded, and 51 of these were optimal"
)
MISSION: Final = (
    "Its method: box detector, depth at the middle of the box, uncontrolled rotator, movement primitives, P law. It "
    "does not know when the bunk is full, and lays logs onto the load. Its rules: its field. With everything: other "
    "fields, calibrated individual machines. Logs of the second lap that were never laid, because the first one "
    "still lay there, do not count. Rendered pictures"
)
BOXES: Final = "A small box detector in the role of YOLOv3, on rendered pictures; the paper: photographs"
MEASURE: Final = "Its method by its own measure (peak of a histogram, Fig. 17), ours by the distance in space"
COMPARISONS: Final = (
    Comparison(
        "Grasp attempts that lift a log",
        "A",
        "grasp-configs",
        "paper60_success",
        60,
        "faithful.cnn.first_closing",
        "first_closing",
        "success",
        CHAIN,
    ),
    Comparison(
        "Optimal ones of the successful",
        "A",
        "grasp-configs",
        "optimal",
        59,
        "faithful.cnn.optimal",
        "optimal",
        "",
        CHAIN,
    ),
    Comparison(
        "Correct grasps on Cornell, views split at random",
        "A",
        "grasp-network",
        "cornell_paper_split",
        0,
        "cornell_paper_split",
        "",
        "",
        "Its network and training on the 80 of 885 pictures that are at hand",
    ),
    Comparison("Parameters of the network", "A", "grasp-network", "parameters", 0, "parameters", "", "", ""),
    Comparison(
        "Logs loaded", "B", "forwarding-mission", "loaded", 24, "faithful.loaded", "first.loaded", "loaded", MISSION
    ),
    Comparison(
        "Logs detected",
        "B",
        "forwarding-mission",
        "detected",
        24,
        "faithful.detected",
        "first.detected",
        "detected",
        MISSION,
    ),
    Comparison(
        "Grapple to log before it closes, mean",
        "B",
        "forwarding-mission",
        "grasp_offset_mean_m",
        0,
        "faithful.grasp_offset_mean_m",
        "first.grasp_offset_mean_m",
        "grasp_offset_mean_m",
        MISSION,
    ),
    Comparison("Boxes of logs, mAP@0.5", "B", "detector", "map50", 0, "faithful.map50", "", "map50", BOXES),
    *(
        Comparison(
            f"Position of a log {view}",
            "B",
            "log-localization",
            f"faithful.deg{degrees}.peak_m",
            0,
            f"faithful.deg{degrees}.peak_m",
            f"deg{degrees}.median_m",
            "",
            MEASURE,
        )
        for degrees, view in ((0, "across the view"), (45, "at 45 degrees"), (90, "end-on"))
    ),
    *(
        Comparison(
            f"Crane tip at its goal by encoders, {title}",
            "B",
            "crane-accuracy",
            f"encoder_error{part}_mean_m",
            0,
            "",
            f"encoder_error{part}_mean_m",
            "",
            "Its four goals and loads; a calibrated virtual machine against a real one",
        )
        for part, title in (("", "3-D"), ("_xy", "horizontal"), ("_z", "height"))
    ),
    Comparison(
        "Settling of the heading after a bend",
        "B",
        "navigation",
        "heading_deg_per_m",
        0,
        "heading_deg_per_m",
        "",
        "",
        "",
    ),
)
UNSEEN: Final = (
    "**Real wood and ground**: bark that tears, branches, snow, wet bark, logs frozen together, stumps under a pile. "
    "The plant's logs are rods with drawn bow, taper and friction.",
    "**Real light and dirt**: the pictures are rendered; dust, rain on the glass, low sun and motion blur are models "
    "or missing. The detector's figures on photographs are few.",
    "**Hydraulics that age**: leakage, air in the oil, oil that is cold, valves that stick. Only what the truth file "
    "names varies.",
    "**Errors that repeat**: the noise of the stereo camera is new in every picture. That of a real one stays with the "
    "scene in part, and several pictures do not average it away.",
    "**The time to think**: virtual time stands still while perception and planner compute, so no duration of a "
    "mission in lockstep holds it.",
    "**Fatigue, wear and misuse**: no run lasts longer than a shift, and nobody walks into the working area.",
    "**This computer on a vibrating machine**: timing is measured on hosts in a room.",
    "**The gap itself**: how far the plant is from a machine is unknown until a calibrated machine repeats a figure. "
    "Two systems above made that step: paper A from 59 of 60 to 58 of 60, FPInnovations' heuristic from 87 % to 67 %, "
    "judged differently ([others' work](others.md)).",
)
"""What no figure of a plant can show."""
