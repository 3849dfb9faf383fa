"""Metrics of the grasp-network experiment with their limits, and the page that shows them."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Metric
from experiments.common.result_page import Section
from experiments.grasp_network.latency import MAX_ANGLE_DEG, MAX_DISTANCE_PX, PATHS

PAPER: Final = {"parameters": 78_803.0, "cornell_paper_split": 0.838}
MAX_LATENCY_RATIO: Final = 0.4

CONCLUSION: Final = (
    "The network has {parameters} parameters, as paper A's. With paper A's split {cornell_paper_split} of its grasps "
    "on Cornell samples are correct (paper: {paper:cornell_paper_split} with eleven times the data), with separate "
    "objects {cornell_grouped}.",
    "The fastest path needs {latency_ratio} of the time of PyTorch in eager mode.",
)
INTRODUCTION: Final = (
    "Paper A plans grasps with a small network. This experiment checks that ours is the same network, what it has "
    "learnt from the 80 available Cornell samples, and how fast it runs."
)

SIZE = (
    Metric(
        "parameters",
        "Trained parameters",
        "",
        "Counted over all layers of Table I; the second 32-channel layer has 25 632, the table's 12 832 is a misprint.",
        78_803.0,
        78_803.0,
    ),
)

_CORRECT = (
    "More than 25 % IoU with a label and less than 30 degrees from it. The network predicts no opening, so the "
    "rectangle has the median size of the training labels"
)
CORNELL = (
    Metric(
        "cornell_paper_split",
        "Correct grasps, views split at random (as in the paper)",
        "%",
        f"10 folds over ten views of every sample. {_CORRECT}. Views of one picture are in both parts and not "
        "independent, so the interval is too narrow. The limit is paper A's figure.",
        least=PAPER["cornell_paper_split"],
    ),
    Metric(
        "cornell_grouped",
        "Correct grasps, objects kept apart",
        "%",
        "10 folds of neighbouring numbers; 4 numbers on either side are left out of the training; tested on the "
        "original crops.",
    ),
    Metric(
        "cornell_paper_split_own_size",
        "Correct grasps with the size of the label, views split at random",
        "%",
        "The rectangle has the size of the label it is compared with: only place and direction count.",
    ),
    Metric(
        "cornell_grouped_own_size",
        "Correct grasps with the size of the label, objects kept apart",
        "%",
        "As with views split at random.",
    ),
)

DATA = (
    Metric(
        "data_right",
        "Correct grasps on the folder given by --data",
        "%",
        f"Shipped weights, original crops, f32 as on the machine. {_CORRECT}.",
    ),
    Metric(
        "data_own_size",
        "Correct grasps on that folder with the size of the label",
        "%",
        "Only place and direction count.",
    ),
    Metric("data_trained_on", "Samples in that folder that were used for training", "", "By number."),
)

AGREEMENT = (
    "Over rendered log scenes and the available Cornell samples; if two places are equally good, either may win."
)
LATENCY = (
    Metric(
        "latency_ratio",
        "Fastest path over PyTorch eager",
        "",
        "Median CPU time per picture of the fastest path whose grasp agrees with PyTorch's, over the original "
        "network in PyTorch eager mode; one thread, paths measured alternately.",
        most=MAX_LATENCY_RATIO,
    ),
    Metric("argmax_px", "Distance of its grasp from PyTorch's, 95th percentile", "px", AGREEMENT, most=MAX_DISTANCE_PX),
    Metric("angle_deg", "Angle of its grasp from PyTorch's, 95th percentile", "deg", AGREEMENT, most=MAX_ANGLE_DEG),
    Metric(
        "prepare_ms",
        "Preprocessing from depth to network input",
        "ms",
        "Ground plane and scaling; the same for all paths.",
    ),
    *(
        Metric(f"{name}_ms", f"Time of a picture, {title}", "ms", "From picture to grasp, median CPU time.")
        for name, title in PATHS.items()
    ),
    *(
        Metric(f"{name}_ratio", f"{title}, over PyTorch eager", "", "Ratio of the medians.")
        for name, title in PATHS.items()
    ),
)

METRICS: Final = (*SIZE, *CORNELL, *DATA, *LATENCY)

SECTIONS: Final = (
    Section(
        "The network",
        "Table I of the paper, layer by layer; `tests/autonomy/test_grasp_network.py` checks every row of it.",
        SIZE,
        (),
    ),
    Section(
        "Cornell samples",
        "Depth only, 80 samples (0100 to 0179) instead of the paper's 885: with a ninth of the "
        "data the paper's value is a reference, not an equal goal. The data have no explicit licence, so nothing "
        "of them is shown here. The ground plane is removed from the depth first, which the paper does not state.",
        CORNELL,
        (("cornell.png", "Correct grasps with Wilson 95 % intervals; dashed: the paper."),),
    ),
    Section(
        "Another folder",
        "`timberhand experiment grasp-network --data DIR` evaluates the shipped weights on any "
        "folder in the Cornell layout.",
        DATA,
        (),
    ),
    Section(
        "Latency",
        'All paths run the same trained network. "Grasp only": the heads before the upsampling, and '
        "the "
        "argmax at a third of the side, where bilinear interpolation by an odd factor has its maxima too. "
        '"Mixed": everything in bf16, then the last convolution and the heads again in f32 at the best places; '
        "with bf16 alone the grasp would move on plateaus of the quality.",
        LATENCY,
        (("latency.png", "Time of a picture relative to PyTorch eager; whiskers: quartiles."),),
    ),
    Section(
        "Logs",
        "The network was trained on objects of a hand's size and has never seen a log. These are its maps of logs seen "
        "by paper A's virtual camera, as in Fig. 5 of the paper.",
        (),
        (
            (
                "logs.png",
                "Height above the ground, and grasp quality with the chosen grasp (green: the closing direction).",
            ),
        ),
    ),
)
