"""The figures of the experiment, their limits and its page."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from experiments.common.result import Figure
from experiments.common.result_page import Section

WORDS: Final = {
    "true": "true poses",
    "ours": "our perception",
    "masked": "our perception, true masks",
    "faithful": "paper A's perception",
}
BY: Final = {"search": "search", "cnn": "paper A's network", "cnn_physical": "the network on physical labels"}


def _pair(poses: str, planner: str) -> tuple[Figure, ...]:
    name, words = f"{poses}.{planner}", f"{WORDS[poses]}, {BY[planner]}"
    return (
        Figure(f"{name}.success", f"Success: {words}", "%", "Of all attempts, by the plant's physics.", scale=100.0),
        Figure(f"{name}.optimal", f"Optimal of these: {words}", "%", "Of the successful ones.", scale=100.0),
        Figure(f"{name}.logs_per_grasp_10_12", f"Logs per grasp in 10 to 12: {words}", "", "Mean."),
    )


JUDGED: Final = (
    Figure("paper60_success", "Success of 60 attempts as in the paper", "%",
           "Five attempts with each configuration: a log at least hangs clear of the ground after 2 s.", scale=100.0),
    Figure("success", "Success", "%", "The same of all attempts.", least=0.99, scale=100.0),
    Figure("first_closing", "Lifted at the first closing of the tongs", "%",
           "The rest of the successful ones took a second closing before the lift, or more.", scale=100.0),
    Figure("nominal.success", "Success of the nominal machine", "%", "Of its attempts.", scale=100.0),
    Figure("individuals.success", "Success of calibrated individuals", "%",
           "Of the attempts of five machines drawn around the nominal one.", scale=100.0),
    Figure("success_wilson_low", "Success, lower bound of the Wilson 95 % interval", "%",
           "To be above paper A's 59 of 60.", least=0.9833, scale=100.0),
    Figure("optimal", "Optimal grasps of the successful ones", "%",
           "Neither from under another log nor at an edge (NI), aligned within 20 deg (MA), not misled by perception "
           "(SE).", least=0.95, scale=100.0),
    Figure("ni", "Sub-optimal: not intuitive", "", "From under another log, or at an edge."),
    Figure("se", "Sub-optimal: segmentation error", "", "Sub-optimal where perception missed or misplaced a log."),
    Figure("ma", "Sub-optimal: misaligned", "", "More than 20 deg off the logs' mean direction."),
    Figure("logs_per_grasp_10_12", "Logs per grasp in configurations 10 to 12", "", "Mean of all attempts.",
           least=1.5),
    Figure("all_logs", "All logs at once in configurations 2, 4, 5, 6, 7", "%",
           "As the paper observed consistently.", scale=100.0),
    Figure("plan_ms", "Perceive and plan", "ms", "Time of the processor from a picture to the grasp: one picture's "
           "perception and the choice of the grasp, median.", most=60.0, clocked=True),
    Figure("perceive_ms", "Of which perception", "ms", "The same attempts, median.", clocked=True),
    Figure("choose_ms", "Of which the choice of the grasp", "ms", "The same attempts, median.", clocked=True),
)  # fmt: skip
ABLATION: Final = tuple(f for poses in WORDS for planner in BY for f in _pair(poses, planner))
PER_CONFIGURATION: Final = tuple(
    Figure(f"config{n}.{what}", f"Configuration {n}: {words}", unit, "Of its attempts.", scale=scale)
    for n in range(1, 13)
    for what, words, unit, scale in (
        ("success", "success", "%", 100.0), ("optimal", "optimal", "%", 100.0), ("logs", "logs per grasp", "", 1.0)
    )
)  # fmt: skip
FIGURES: Final = (*JUDGED, *PER_CONFIGURATION, *ABLATION)
SECTIONS: Final = (
    Section(
        "Twelve configurations",
        "Logs of random size lie at a random place in a random direction in one of paper A's arrangements (rebuilt "
        "from its sentences). One grasp, lifted and held for two seconds; physics alone judges. The camera's mount "
        "and scale of depth are surveyed before the run. Logs are seen from where the crane stands at first; where "
        "a grasp is of logs among others, ours looks again from above it, twice at most, and plans anew. What the "
        "tongs tell before anything is lifted is used, too: where they stall at the sides of a heap, or wider than "
        "what they are to hold, they open again and close higher up, three times at most; where they have shut on "
        "nothing or pinch a log that they were to be under, or turn out to be shut and to weigh nothing when they "
        "have risen by 0.2 m, they open, look again and are sent anew, twice at most. That counts as the same "
        "attempt; how many needed no second closing is told beside it.",
        JUDGED,
        (("chain.png", "As paper A's Fig. 5: the pile, the virtual depth picture with the grasp of the search, "
          "the network's quality with its grasp."),),
    ),
    Section(
        "By configuration",
        "As paper A's Table II.",
        PER_CONFIGURATION,
        (("configurations.png", "Share of the attempts by outcome, and logs per grasp."),),
    ),
    Section(
        "What perception and planner are worth",
        "Every source of poses with every planner, on the same scenes. No planner sees the plant's truth but with the "
        "true poses.",
        ABLATION,
        (),
    ),
)  # fmt: skip


def sections(since: str = "") -> tuple[Section, ...]:
    """The page's parts; ``since``: the commit at which the ablation was measured, where that is not the result's."""
    *parts, ablation = SECTIONS
    return (
        *parts,
        replace(ablation, text=f"{ablation.text} Measured before, at commit `{since}`.") if since else ablation,
    )


INTRODUCTION: Final = (
    "Paper A's grasping attempts on the virtual test-bed: camera, segmentation, plan, crane on the bus, lift. "
    "`timberhand experiment grasp-configs --docs docs` measures everything and writes this page; no number is typed."
)
