"""Labels of log pictures under mirroring, windows and scaling."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.training.drawn_logs import picture
from training.pictures.labels import (
    ANGLE,
    CENTRE_U,
    END_U,
    END_V,
    ID,
    START_U,
    START_V,
    cropped,
    enlarged,
    mirrored,
)

LOGS = (((60.0, 60.0), 0.4, 80, 10), ((110.0, 110.0), 1.2, 60, 12))


def test_mirroring_twice_is_the_identity():
    sample = picture(*LOGS)
    twice = mirrored(mirrored(sample))
    assert np.array_equal(twice.ids, sample.ids)
    assert np.allclose(twice.logs, sample.logs, atol=1e-4)
    assert twice.intrinsics == sample.intrinsics


def test_a_mirrored_label_agrees_with_its_pixels():
    sample = mirrored(picture(*LOGS))
    v, u = np.nonzero(sample.ids == 1)
    assert sample.logs[0, CENTRE_U] == pytest.approx(u.mean(), abs=1.0)
    slope = np.linalg.eigh(np.cov(np.stack([u, v]).astype(float)))[1][:, -1]
    assert abs(math.remainder(math.atan2(slope[1], slope[0]) - sample.logs[0, ANGLE], math.pi)) < 0.02


def test_a_window_determines_the_visible_part_again():
    sample = picture(((60.0, 70.0), 0.0, 100, 10))
    left = cropped(sample, 0, 20, 64)
    assert left.ids.shape == (64, 64)
    assert left.logs[0, CENTRE_U] == pytest.approx((10 + 63) / 2, abs=1.0)  # of columns 10..63
    assert left.logs[0, [START_U, START_V]] == pytest.approx((10.0, 50.0))
    assert cropped(sample, 40, 30, 80).logs[0, [END_U, END_V]] == pytest.approx((70.0, 40.0))
    assert cropped(sample, 0, 90, 64).logs.shape[0] == 0
    u = 30
    assert (u - left.intrinsics.cx_px) / left.intrinsics.fx_px == (
        u - sample.intrinsics.cx_px
    ) / sample.intrinsics.fx_px


def test_heights_move_with_the_pixels():
    sample = replace(picture(*LOGS), height_m=np.arange(160 * 160, dtype=np.float32).reshape(160, 160))
    assert cropped(mirrored(sample), 10, 20, 64).height_m[0, 0] == sample.height_m[20, 159 - 10]
    assert cropped(picture(*LOGS), 10, 20, 64).height_m is None


def test_enlarged_labels_agree_with_their_pixels():
    large = enlarged(picture(*LOGS))
    assert large.rgb.shape == (320, 320, 3) and large.ids.shape == large.depth_m.shape == (320, 320)
    for log in large.logs:
        _, u = np.nonzero(large.ids == log[ID])
        assert log[CENTRE_U] == pytest.approx((u.min() + u.max()) / 2, abs=1.5)
    assert large.logs[0, ANGLE] == picture(*LOGS).logs[0, ANGLE]
