"""The shipped networks: cards that match the weights, and detections."""

import hashlib

import numpy as np
import pytest

from autonomy.networks import SHIPPED
from autonomy.perception.papers import SIZE_PX, BoxDetector
from autonomy.perception.segmentation.log_segmenter import LogSegmenter
from training.common.average_precision import box_overlaps
from training.detection.detector_weights import box_of
from training.pictures.drawing import draw
from training.pictures.labels import ID
from training.pictures.piles import settle

WELL_SHOWN_PX = 600


@pytest.fixture(scope="module")
def seen():
    """Some pictures of four crossed logs, with the boxes of those that show well."""
    pile = settle("palms_471", 5)
    samples = [draw(pile, seed) for seed in range(24)]
    shown = [[s.ids == log[ID] for log in s.logs] for s in samples]
    return [
        (s, np.array([box_of(m) for m in masks if m.sum() > WELL_SHOWN_PX]).reshape(-1, 4))
        for s, masks in zip(samples, shown, strict=True)
    ]


def found(boxes_of, seen) -> float:
    """The share of the logs that show well that one of the boxes lies on."""
    best = [box_overlaps(boxes_of(s), truth).max(axis=0, initial=0.0) for s, truth in seen if len(truth)]
    return float(np.mean(np.concatenate(best) > 0.5))


@pytest.mark.parametrize("weights", sorted(SHIPPED.glob("*.onnx")), ids=lambda path: path.stem)
def test_the_card_matches_the_weights(weights):
    assert hashlib.sha256(weights.read_bytes()).hexdigest() in weights.with_suffix(".md").read_text()
    assert weights.stat().st_size < 5_000_000


@pytest.mark.long
@pytest.mark.parametrize(("variant", "least"), [("rgbd", 0.7), ("depth", 0.55)])
def test_well_visible_logs_are_segmented(variant, least, seen):
    detector = LogSegmenter(variant)
    share = found(lambda s: [i.box_px for i in detector.segment_picture(s.rgb, s.depth_m, s.intrinsics)], seen)
    assert share >= least, share


def test_the_depth_variant_ignores_colour(seen):
    detector = LogSegmenter("depth")
    sample = next(s for s, truth in seen if len(truth) > 2)
    plain = detector.segment_picture(sample.rgb, sample.depth_m, sample.intrinsics)
    dark = detector.segment_picture(np.full_like(sample.rgb, 7), sample.depth_m, sample.intrinsics)
    assert plain and [i.box_px for i in plain] == [i.box_px for i in dark]


@pytest.mark.long
def test_boxes_from_colour_overlap_logs(seen):
    detector = BoxDetector()

    def boxes_of(sample):
        square = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)
        square[: sample.rgb.shape[0], : sample.rgb.shape[1]] = sample.rgb
        return detector.detect(square)[0]

    assert found(boxes_of, seen) >= 0.5
