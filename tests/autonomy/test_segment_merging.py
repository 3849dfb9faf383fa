"""Segments split by boundaries, and segments that are one log."""

import numpy as np
import pytest

from autonomy.perception.segmentation.instances import foreground_of
from autonomy.perception.segmentation.network import STRIDE
from autonomy.perception.segmentation.segment_merging import (
    SegmentMerger,
    load_scorers,
    over_segment,
    segment_logs,
    shipped_scorers,
)
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES, SegmentTable, pair_features
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, boundary_map, make_segment, watershed
from runtime.errors import InputRefused
from tests.codes import coded
from tests.training.drawn_logs import perfect_maps, picture
from training.detection import scorer_weights
from training.detection.scorer_weights import quality_examples
from training.detection.segmentation import targets

ROOM = np.ones((20, 60), bool)


def walled(height):
    """Two basins of height 0.1 with a boundary of ``height`` between them in row 10."""
    boundary = np.full(ROOM.shape, 0.1)
    boundary[10] = height
    return boundary


def test_a_strong_boundary_splits_and_a_weak_one_does_not():
    labels = watershed(walled(0.6), ROOM)
    assert len(np.unique(labels[:10])) == len(np.unique(labels[11:])) == 1
    assert labels[0, 0] != labels[19, 0] and labels.all()
    assert len(np.unique(watershed(walled(0.14), ROOM))) == 1


def test_a_shallow_basin_joins_the_deep_one_that_it_meets():
    boundary = walled(0.6)
    boundary[11:] = 0.5  # a step of the boundary, not a basin of its own
    assert len(np.unique(watershed(boundary, ROOM))) == 1


def test_three_basins_stay_separate_where_they_meet():
    boundary = walled(0.7)
    boundary[:10, 30] = 0.7
    labels = watershed(boundary, ROOM)
    assert len({labels[0, 0], labels[0, 59], labels[19, 30]}) == 3


def test_nothing_outside_the_foreground_is_labelled():
    some = ROOM.copy()
    some[:, 20:30] = False
    labels = watershed(walled(0.1), some)
    assert not labels[:, 20:30].any() and labels[0, 0] != labels[0, 59]
    assert not watershed(walled(0.1), np.zeros_like(ROOM)).any()


def test_an_isolated_pixel_is_not_labelled():
    some = ROOM.copy()
    some[:, 50:] = False
    some[3, 55] = True
    labels = watershed(walled(0.6), some)
    assert labels[3, 55] == 0 and labels[some].astype(bool).sum() == some.sum() - 1


def foreground_of_logs(*logs):
    """The foreground of perfect maps, and the log of every pixel of the maps."""
    sample = picture(*logs, size=208)
    foreground = foreground_of(perfect_maps(targets(sample)[0]), STRIDE, sample.depth_m)
    return foreground, sample.ids[1::STRIDE, 1::STRIDE].astype(int)


def logs_of(*logs):
    return segment_logs(foreground_of_logs(*logs)[0], shipped_scorers())


@pytest.mark.parametrize("away", [30.0, 60.0])
def test_a_log_that_another_crosses_is_one_log(away):
    assert len(logs_of(((100, 100), 0.3, 150, 16), ((100 + away / 2, 100), 1.7, 120, 16))) == 2


def test_two_logs_in_line_stay_two():
    assert len(logs_of(((60, 100), 0.0, 80, 14), ((150, 100), 0.0, 80, 14))) == 2  # ground between them
    assert len(logs_of(((60, 100), 0.0, 80, 14), ((141, 100), 0.0, 80, 14))) == 2  # they touch, but vote apart


def test_logs_are_ordered_by_size_and_share_no_pixel():
    found = logs_of(((60, 60), 0.2, 60, 12), ((120, 140), 0.4, 120, 18))
    assert len(found[0].members) > len(found[1].members)
    assert abs(np.arctan2(found[0].axis[1], found[0].axis[0]) - 0.4) < 0.02
    assert len(np.unique(np.concatenate([r.members for r in found]))) == sum(len(r.members) for r in found)


CROSSED = (((100, 100), 0.3, 150, 16), ((115, 100), 1.7, 120, 16))


def related(foreground, a, b, touch=0.0):
    big, small = (SegmentTable.of([make_segment(foreground, np.flatnonzero(members))]) for members in (a, b))
    features = pair_features(foreground, big, small, np.array([touch]), np.zeros(1))
    return dict(zip(PAIR_FEATURES, features[0].tolist(), strict=True))


def test_a_turn_of_the_axis_is_a_boundary_without_an_edge():
    maps = np.zeros((8, 20, 40), np.float32)
    maps[7] = -9.0
    maps[4, :, :20], maps[5, :, 20:] = 1.0, 1.0
    high = boundary_map(maps)
    assert (high[:, 19:21] > 0.4).all() and (high[:, :18] < 0.01).all()


def test_both_parts_of_a_crossed_log_are_on_one_line_in_depth():
    foreground, ids = foreground_of_logs(*CROSSED)
    of = ids[foreground.y, foreground.x] == 1
    left, right = of & (foreground.x < 45), of & (foreground.x > 65)
    features = related(foreground, left, right)
    assert features["depth_known"] == 1.0 and features["depth_difference"] < 0.3
    assert features["gap"] > 0.1 and features["gap_background"] == 0.0 and features["turn"] < 0.1


def test_a_gap_behind_an_occluder_is_not_background():
    foreground, ids = foreground_of_logs(((60, 100), 0.0, 60, 14), ((150, 100), 0.0, 60, 14))
    members = [ids[foreground.y, foreground.x] == i for i in (1, 2)]
    assert related(foreground, *members)["gap_background"] > 0.9
    foreground.inverse[:, 46:60] *= 1.2  # a post before both
    assert related(foreground, *members)["gap_background"] < 0.4


def test_a_merged_segment_has_the_borders_of_both():
    foreground, _ = foreground_of_logs(*CROSSED)
    merger = SegmentMerger(foreground, over_segment(foreground))
    touch = merger._border_px.copy()
    n = len(merger.segments)
    merger.merge_pair(0, n - 1)
    assert len(merger.segments) == n - 1
    assert merger._border_px[0, 1] == touch[0, 1] + touch[n - 1, 1] and merger._border_px[0, 0] == 0.0
    pairs, features = merger.pairs()
    fresh_pairs, fresh = SegmentMerger(foreground, merger.segments).pairs()
    assert np.array_equal(pairs, fresh_pairs)
    assert np.abs(features - fresh)[:, 3:].max() < 1e-6  # what does not depend on borders between the two


def test_examples_have_both_answers():
    foreground, ids = foreground_of_logs(*CROSSED)
    pairs = scorer_weights.merge_examples(foreground, ids, np.random.default_rng(1))
    assert pairs.features.shape[1] == len(PAIR_FEATURES) and set(pairs.target) == {0.0, 1.0}
    whole = quality_examples(foreground, ids, shipped_scorers().merge)
    assert whole.features.shape == (2, len(SEGMENT_FEATURES)) and (whole.target > 0.85).all()


def test_a_picture_without_logs_has_no_segments():
    foreground, ids = foreground_of_logs()
    none = quality_examples(foreground, ids, shipped_scorers().merge)
    assert logs_of() == [] and none.features.shape == (0, len(SEGMENT_FEATURES)) and none.features.dtype == np.float32


def test_missing_scorers_are_refused(tmp_path):
    with pytest.raises(InputRefused, check=coded("weights.missing")):
        load_scorers(tmp_path)
