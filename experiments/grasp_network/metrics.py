"""The figures of the experiment and the sections of its page."""

from __future__ import annotations

from typing import Final

from experiments.common.result import Figure
from experiments.common.result_page import Section
from experiments.grasp_network.latency import MOST_DEG, MOST_PX, PATHS

PAPER: Final = {"parameters": 78_803.0, "cornell_paper_split": 0.838}
RATIO: Final = 0.4

SIZE = (
    Figure("parameters", "Trained parameters", "", "Counted over all layers of Table I; the second 32-channel layer "
           "has 25 632, the table's 12 832 is a misprint.", 78_803.0, 78_803.0),
)  # fmt: skip

_RIGHT = (
    "More than 25 % IoU with a label and less than 30 degrees from it. The network tells no opening, so the rectangle "
    "has the median size of the labels trained on"
)
CORNELL = (
    Figure("cornell_paper_split", "Right, copies dealt at random (the paper's way)", "%",
           f"10 folds over ten views of every sample. {_RIGHT}. Copies of one picture are on both sides and not "
           "independent: the interval is too narrow.", scale=100.0),
    Figure("cornell_grouped", "Right, objects kept apart", "%",
           "10 folds of neighbouring numbers, a guard of 4 numbers on either side left out of training; judged on the "
           "plain crops.", scale=100.0),
    Figure("cornell_paper_split_own_size", "The same, paper's way, of the label's size", "%",
           "The rectangle takes the size of the label it is held against: place and direction alone count.",
           scale=100.0),
    Figure("cornell_grouped_own_size", "The same, objects apart, of the label's size", "%", "As above.", scale=100.0),
)  # fmt: skip

DATA = (
    Figure("data_right", "Right on the folder of --data", "%",
           f"Shipped weights, plain crops, f32 as on the machine. {_RIGHT}.", scale=100.0),
    Figure("data_own_size", "The same, of the label's size", "%", "As above.", scale=100.0),
    Figure("data_trained_on", "Samples there that the weights were trained on", "", "By number."),
)  # fmt: skip

AGREE = "Over drawn log scenes and the Cornell samples at hand; where two places are as good, either may be chosen."
LATENCY = (
    Figure("latency_ratio", "Fastest path over torch eager", "",
           "Median processor time of a picture, of the fastest path whose grasp agrees with torch's, over the "
           "unchanged network's in torch eager; one thread, the paths taking turns.", most=RATIO),
    Figure("argmax_px", "Its grasp from torch's, 95th percentile", "px", AGREE, most=MOST_PX),
    Figure("angle_deg", "Its direction from torch's, 95th percentile", "deg", AGREE, most=MOST_DEG),
    Figure("prepare_ms", "Depth to network input", "ms", "Ground plane and scaling; the same for all paths."),
    *(Figure(f"{name}_ms", words, "ms", "Picture to grasp, median processor time.") for name, words in PATHS.items()),
    *(Figure(f"{name}_ratio", f"{words}, over torch eager", "", "Of the medians.") for name, words in PATHS.items()),
)  # fmt: skip

FIGURES: Final = (*SIZE, *CORNELL, *DATA, *LATENCY)

SECTIONS: Final = (
    Section("The network", "Table I of the paper, layer by layer; `tests/autonomy/test_grasp_network.py` holds every "
            "row of it.", SIZE, ()),
    Section("On Cornell samples", "Depth alone, 80 samples (0100 to 0179) beside the paper's 885: a ninth of its data, "
            "so the paper's figure is an anchor, not a like-for-like goal. The data have no explicit licence; nothing "
            "of them is shown here. The ground plane is taken out of the depth first, which the paper does not say.",
            CORNELL, (("cornell.png", "Right grasps with Wilson's 95 % intervals; dashed: the paper"),)),
    Section("On another folder", "`timberhand experiment grasp-network --data DIR` judges the shipped weights on any "
            "folder in the Cornell layout.", DATA, ()),
    Section("What a picture costs", "All paths run the same trained network. \"The grasp alone\": the heads before the "
            "upsampling, and the argmax at a third of the side, where bilinear interpolation by an odd factor has it "
            "too. \"Mixed\": all in bf16, then the last convolution and the heads again in f32 at the best "
            "places; in bf16 alone the grasp would wander over flat quality.", LATENCY,
            (("latency.png", "Time of a picture relative to torch eager; whiskers: quartiles"),)),
    Section("On logs", "The network was trained on objects of a hand's size and never shown a log. These are its maps "
            "of logs as paper A's virtual camera sees them, like its Fig. 5.", (),
            (("logs.png", "Height above the ground, and grasp quality with the chosen grasp (green: the closing "
              "direction)"),)),
)  # fmt: skip
