"""Regions that edges part, and regions that are one log."""

import numpy as np
import pytest
from drawn_logs import perfect_maps, picture

from autonomy.perception.regions import flooded, parted, sigmoid
from autonomy.training.segmentation import targets

ROOM = np.ones((20, 60), bool)


def walled(height):
    """Two valleys 0.1 high, a wall of ``height`` between them in row 10."""
    wall = np.full(ROOM.shape, 0.1)
    wall[10] = height
    return wall


def test_a_wall_parts_and_a_ripple_does_not():
    labels = flooded(walled(0.6), ROOM)
    assert len(np.unique(labels[:10])) == len(np.unique(labels[11:])) == 1
    assert labels[0, 0] != labels[19, 0] and labels.all()
    assert len(np.unique(flooded(walled(0.25), ROOM))) == 1


def test_a_shallow_basin_above_goes_to_the_deep_one_it_meets():
    wall = walled(0.6)
    wall[11:] = 0.5  # a step of the wall, not a valley of its own
    assert len(np.unique(flooded(wall, ROOM))) == 1


def test_three_pools_stay_three_where_they_meet():
    wall = walled(0.7)
    wall[:10, 30] = 0.7
    labels = flooded(wall, ROOM)
    assert len({labels[0, 0], labels[0, 59], labels[19, 30]}) == 3


def test_nothing_outside_the_foreground_is_labelled():
    some = ROOM.copy()
    some[:, 20:30] = False
    labels = flooded(walled(0.1), some)
    assert not labels[:, 20:30].any() and labels[0, 0] != labels[0, 59]
    assert not flooded(walled(0.1), np.zeros_like(ROOM)).any()


def test_a_speck_is_no_part_of_a_log():
    some = ROOM.copy()
    some[:, 50:] = False
    some[3, 55] = True
    labels = flooded(walled(0.6), some)
    assert labels[3, 55] == 0 and labels[some].astype(bool).sum() == some.sum() - 1


def regions(*logs):
    sample = picture(*logs, size=208)
    maps = perfect_maps(targets(sample)[0])
    sure = sigmoid(maps[0])
    y, x = np.nonzero(sure > 0.5)
    return parted(maps, x, y, sure[y, x])


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
