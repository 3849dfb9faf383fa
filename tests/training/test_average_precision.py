"""Average precision on cases worked out by hand."""

import numpy as np
import pytest

from training.common.average_precision import (
    Matches,
    average_precision,
    box_overlaps,
    curve,
    mask_overlaps,
)


def matches(scores, overlaps, ignored=None):
    overlaps = np.array(overlaps, float).reshape(len(scores), -1)
    return Matches(np.array(scores, float), overlaps, np.array(ignored or [False] * overlaps.shape[1], bool))


def test_overlaps_of_boxes():
    found = [(0, 0, 10, 10), (5, 0, 15, 10), (20, 20, 20, 30)]
    assert box_overlaps(found, [(0, 0, 10, 10)])[:, 0] == pytest.approx([1.0, 1 / 3, 0.0])
    assert box_overlaps([], [(0, 0, 1, 1)]).shape == (0, 1)
    assert box_overlaps([(0, 0, 1, 1)], []).shape == (1, 0)


def test_overlaps_of_masks():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    a[:2], b[1:3] = True, True
    assert mask_overlaps([a, b], [b])[:, 0] == pytest.approx([1 / 3, 1.0])
    assert mask_overlaps([], [a]).shape == (0, 1)


def test_perfect_detections_give_one():
    assert curve([matches([0.9, 0.8], [[0.9, 0.0], [0.0, 0.6]])], 0.5).average == pytest.approx(1.0)


def test_a_false_detection_with_a_higher_score_halves_precision():
    # Surest is wrong: precision 1/2 at every recall up to 1.
    assert curve([matches([0.9, 0.8], [[0.0], [0.7]])], 0.5).average == pytest.approx(0.5)
    # Less sure than the right one: harmless.
    assert curve([matches([0.8, 0.9], [[0.0], [0.7]])], 0.5).average == pytest.approx(1.0)


def test_a_ground_truth_is_matched_once():
    double = curve([matches([0.9, 0.8], [[0.9], [0.9]])], 0.5)
    assert double.precision.tolist() == [1.0, 0.5]
    assert double.average == pytest.approx(1.0)


def test_half_of_the_truths_gives_51_of_101_recalls():
    assert curve([matches([0.9], [[0.9, 0.0]])], 0.5).average == pytest.approx(51 / 101)


def test_a_worked_example_of_two_pictures():
    # By score: right (a), wrong (b), right (b); three truths.  Precision 1, 1/2, 2/3 at recall 1/3, 1/3, 2/3.
    a = matches([0.9], [[0.8, 0.1]])
    b = matches([0.8, 0.7], [[0.2], [0.6]])
    whole = curve([a, b], 0.5)
    assert whole.precision == pytest.approx([1.0, 0.5, 2 / 3])
    assert whole.recall == pytest.approx([1 / 3, 1 / 3, 2 / 3])
    # Recalls 0..0.33 (34 of them) read 1, 0.34..0.66 (33) read 2/3, the rest 0.
    assert whole.average == pytest.approx((34 + 33 * 2 / 3) / 101)


def test_ignored_truths_have_no_effect():
    one = matches([0.9, 0.8], [[0.8, 0.0], [0.0, 0.9]], [True, False])
    assert curve([one], 0.5).average == pytest.approx(1.0)
    assert curve([one], 0.5).scores.tolist() == [0.8]
    # A truth that counts is preferred, even when an ignored one is overlapped more.
    two = matches([0.9], [[0.8, 0.6]], [True, False])
    assert curve([two], 0.5).average == pytest.approx(1.0)


def test_the_mean_over_thresholds_rewards_tight_detections():
    assert average_precision([matches([0.9], [[0.74]])]) == pytest.approx(0.5)  # 0.50, 0.55, 0.60, 0.65, 0.70
    assert average_precision([matches([0.9], [[1.0]])]) == pytest.approx(1.0)


def test_without_truths_the_average_is_nan():
    assert np.isnan(curve([matches([0.5], [[]])], 0.5).average)
    assert curve([Matches(np.zeros(0), np.zeros((0, 1)), np.array([False]))], 0.5).average == 0.0
