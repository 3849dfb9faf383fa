"""Later published systems that load logs, for comparison: what each measured, and our figure that comes nearest.

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
        ("grasp-configs", "success"),
    ),
    Published(
        "Software of the FPInnovations crane 2026",
        "the same; learned scoring",
        "cycles that lifted logs",
        16 / 23,
        23,
        "https://github.com/george-sideris/crane-hierarchical-rl",
        ("grasp-configs", "success"),
    ),
)
PAPER_A: Final = frozenset(
    {
        ("plant", "sag_250kg_6m_m"),
        ("grasp-network", "parameters"),
        ("grasp-network", "cornell_paper_split"),
        ("grasp-configs", "paper60_success"),
        ("grasp-configs", "optimal"),
    }
)
"""Experiments and metrics whose value of the paper is paper A's; that of all others is paper B's."""
UNSEEN: Final = (
    "**Real wood and ground**: bark that tears, branches, snow, wet bark, logs frozen together, stumps under a pile. "
    "The plant's logs are rods with drawn bow, taper and friction.",
    "**Real light and dirt**: the pictures are rendered; dust, rain on the glass, low sun and motion blur are models "
    "or missing. The detector's figures on photographs are few.",
    "**Hydraulics that age**: leakage, air in the oil, oil that is cold, valves that stick. Only what the truth file "
    "names varies.",
    "**Fatigue, wear and misuse**: no run lasts longer than a shift, and nobody walks into the working area.",
    "**This computer on a vibrating machine**: timing is measured on hosts in a room.",
    "**The gap itself**: how far the plant is from a machine is unknown until a calibrated machine repeats a figure. "
    "Paper A's own step from simulation (59 of 60) to its crane (58 of 60) is the only such pair among the systems "
    "above.",
)
"""What no figure of a plant can show."""
