"""Regions that edges part, and regions that are one log."""

import numpy as np
import pytest
from drawn_logs import perfect_maps, picture

from autonomy.networks.weights import WeightsError
from autonomy.perception.segmentation.instances import foreground_of
from autonomy.perception.segmentation.network import STRIDE
from autonomy.perception.segmentation.segment_merging import SegmentMerger, cut, judges, parted, shipped_scorers
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES, SegmentTable, relations
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, piece
from autonomy.perception.segmentation.watershed import wall, watershed
from training.detection import segment_scorers
from training.detection.segment_scorers import worths
from training.detection.segmentation import targets

ROOM = np.ones((20, 60), bool)


def walled(height):
    """Two valleys 0.1 high, a wall of ``height`` between them in row 10."""
    wall = np.full(ROOM.shape, 0.1)
    wall[10] = height
    return wall


def test_a_wall_parts_and_a_ripple_does_not():
    labels = watershed(walled(0.6), ROOM)
    assert len(np.unique(labels[:10])) == len(np.unique(labels[11:])) == 1
    assert labels[0, 0] != labels[19, 0] and labels.all()
    assert len(np.unique(watershed(walled(0.14), ROOM))) == 1


def test_a_shallow_basin_above_goes_to_the_deep_one_it_meets():
    wall = walled(0.6)
    wall[11:] = 0.5  # a step of the wall, not a valley of its own
    assert len(np.unique(watershed(wall, ROOM))) == 1


def test_three_pools_stay_three_where_they_meet():
    wall = walled(0.7)
    wall[:10, 30] = 0.7
    labels = watershed(wall, ROOM)
    assert len({labels[0, 0], labels[0, 59], labels[19, 30]}) == 3


def test_nothing_outside_the_foreground_is_labelled():
    some = ROOM.copy()
    some[:, 20:30] = False
    labels = watershed(walled(0.1), some)
    assert not labels[:, 20:30].any() and labels[0, 0] != labels[0, 59]
    assert not watershed(walled(0.1), np.zeros_like(ROOM)).any()


def test_a_speck_is_no_part_of_a_log():
    some = ROOM.copy()
    some[:, 50:] = False
    some[3, 55] = True
    labels = watershed(walled(0.6), some)
    assert labels[3, 55] == 0 and labels[some].astype(bool).sum() == some.sum() - 1


def seen(*logs):
    """A scene of perfect maps, and the logs of the maps' pixels."""
    sample = picture(*logs, size=208)
    scene = foreground_of(perfect_maps(targets(sample)[0]), STRIDE, sample.depth_m)
    return scene, sample.ids[1::STRIDE, 1::STRIDE].astype(int)


def regions(*logs):
    return parted(seen(*logs)[0], shipped_scorers())


@pytest.mark.parametrize("away", [30.0, 60.0])
def test_a_log_that_another_crosses_is_one(away):
    assert len(regions(((100, 100), 0.3, 150, 16), ((100 + away / 2, 100), 1.7, 120, 16))) == 2


def test_two_logs_in_line_are_two():
    assert len(regions(((60, 100), 0.0, 80, 14), ((150, 100), 0.0, 80, 14))) == 2  # ground between them
    assert len(regions(((60, 100), 0.0, 80, 14), ((141, 100), 0.0, 80, 14))) == 2  # they touch, but vote apart


def test_the_larger_comes_first_and_all_pixels_are_somebody_s():
    found = regions(((60, 60), 0.2, 60, 12), ((120, 140), 0.4, 120, 18))
    assert len(found[0].own) > len(found[1].own)
    assert abs(np.arctan2(found[0].axis[1], found[0].axis[0]) - 0.4) < 0.02
    assert len(np.unique(np.concatenate([r.own for r in found]))) == sum(len(r.own) for r in found)


CROSSED = (((100, 100), 0.3, 150, 16), ((115, 100), 1.7, 120, 16))


def related(scene, a, b, touch=0.0):
    big, small = (SegmentTable.of([piece(scene, np.flatnonzero(own))]) for own in (a, b))
    told = relations(scene, big, small, np.array([touch]), np.zeros(1))
    return dict(zip(PAIR_FEATURES, told[0].tolist(), strict=True))


def test_the_axis_turning_is_a_wall_where_no_edge_is():
    maps = np.zeros((8, 20, 40), np.float32)
    maps[7] = -9.0
    maps[4, :, :20], maps[5, :, 20:] = 1.0, 1.0
    high = wall(maps)
    assert (high[:, 19:21] > 0.4).all() and (high[:, :18] < 0.01).all()


def test_both_parts_of_a_crossed_log_are_on_one_line_in_depth_too():
    scene, ids = seen(*CROSSED)
    of = ids[scene.y, scene.x] == 1
    left, right = of & (scene.x < 45), of & (scene.x > 65)
    told = related(scene, left, right)
    assert told["depth_known"] == 1.0 and told["depth_apart"] < 0.3
    assert told["gap"] > 0.1 and told["gap_ground"] == 0.0 and told["turn"] < 0.1


def test_what_hides_a_gap_is_no_ground_and_ground_is():
    scene, ids = seen(((60, 100), 0.0, 60, 14), ((150, 100), 0.0, 60, 14))
    own = [ids[scene.y, scene.x] == i for i in (1, 2)]
    assert related(scene, *own)["gap_ground"] > 0.9
    scene.inverse[:, 46:60] *= 1.2  # a post before both
    assert related(scene, *own)["gap_ground"] < 0.4


def test_a_joined_piece_takes_the_borders_of_both():
    scene, _ = seen(*CROSSED)
    joining = SegmentMerger(scene, cut(scene))
    touch = joining._touch.copy()
    n = len(joining.pieces)
    joining.merge(0, n - 1)
    assert len(joining.pieces) == n - 1
    assert joining._touch[0, 1] == touch[0, 1] + touch[n - 1, 1] and joining._touch[0, 0] == 0.0
    pairs, told = joining.pairs()
    fresh_pairs, fresh = SegmentMerger(scene, joining.pieces).pairs()
    assert np.array_equal(pairs, fresh_pairs)
    assert np.abs(told - fresh)[:, 3:].max() < 1e-6  # what does not depend on borders between the two


def test_examples_say_what_is_one_log():
    scene, ids = seen(*CROSSED)
    pairs = segment_scorers.relations(scene, ids, np.random.default_rng(1))
    assert pairs.told.shape[1] == len(PAIR_FEATURES) and set(pairs.answer) == {0.0, 1.0}
    whole = worths(scene, ids, shipped_scorers().joins)
    assert whole.told.shape == (2, len(SEGMENT_FEATURES)) and (whole.answer > 0.85).all()


def test_a_picture_without_logs_has_no_regions():
    scene, ids = seen()
    none = worths(scene, ids, shipped_scorers().joins)
    assert regions() == [] and none.told.shape == (0, len(SEGMENT_FEATURES)) and none.told.dtype == np.float32


def test_missing_judges_are_named(tmp_path):
    with pytest.raises(WeightsError, match="no such weight file"):
        judges(tmp_path)
