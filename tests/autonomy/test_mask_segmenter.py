"""The mask network: shapes, kernels to logs, what has no depth is no log, colour alone."""

import numpy as np
import pytest

from autonomy.perception.segmentation.mask_network import FEATURES, KERNEL, mask_input
from autonomy.perception.segmentation.mask_segmenter import MaskSegmenter, decoded, kernel_logs
from autonomy.perception.segmentation.network import COS2, MAPS, MASK
from machine.geometry.optics import Intrinsics
from training.common.weight_file import parameter_count
from training.detection.networks import MaskNetwork


def answer() -> tuple[np.ndarray, np.ndarray]:
    """Maps and kernels of two parallel logs that a kernel each bounds by squares of the place."""
    maps = np.full((len(MAPS) + FEATURES, 64, 64), -8.0, np.float32)
    maps[len(MAPS) :] = 0.0
    maps[COS2] = 1.0
    kernels = np.zeros((1 + KERNEL, 16, 16), np.float32)
    kernels[0] = -8.0
    for row in (4, 10):
        middle = 4 * row + 1
        maps[MASK, middle - 4 : middle + 5, 6:58] = 8.0
        kernels[0, row, 8] = 4.0
        kernels[1 + FEATURES + 4, row, 8], kernels[-1, row, 8] = -100.0, 4.0
    return maps, kernels


def test_each_kernel_is_a_log():
    found = kernel_logs(*answer())
    assert len(found.logs) == 2
    assert all(np.ptp(found.y[log.members]) <= 9 and np.ptp(found.x[log.members]) >= 50 for log in found.logs)


def test_two_kernels_of_one_log_are_one():
    """Each of them is surer of its own half, so that without suppression they would share the log."""
    maps, kernels = answer()
    for column, slope in ((4, -0.9), (12, 0.9)):
        kernels[:, 4, column] = kernels[:, 4, 8]
        kernels[1 + FEATURES, 4, column] = slope
    kernels[0, 4, 8] = -8.0
    found = kernel_logs(maps, kernels)
    assert len(found.logs) == 2
    assert all(np.ptp(found.x[log.members]) >= 50 for log in found.logs)


def test_what_has_no_depth_is_no_log_where_a_picture_has_depth():
    depth = np.full((128, 128), 3.0, np.float32)
    depth[:60] = np.nan
    assert len(decoded(*answer(), 2, depth)) == 1
    assert len(decoded(*answer(), 2, np.full((128, 128), np.nan, np.float32))) == 2


def test_a_missing_sense_is_zero():
    unknown = np.full((64, 64), np.nan, np.float32)
    image = mask_input(np.zeros((64, 64, 3), np.uint8), unknown, Intrinsics(64, 64, 60, 60, 32, 32), unknown)
    assert not image[3:].any() and np.isfinite(image).all()


def test_the_network_is_light():
    assert parameter_count(MaskNetwork()) < 1_700_000


@pytest.mark.parametrize("mode", ["rgbd", "colour", "depth"])
def test_bare_ground_shows_no_log(mode):
    rng = np.random.default_rng(0)
    rgb = rng.integers(60, 90, (192, 256, 3)).astype(np.uint8)
    found = MaskSegmenter(mode).segment_picture(
        rgb, np.full((192, 256), 3.0, np.float32), Intrinsics(256, 192, 200, 200, 128, 96)
    )
    assert not [one for one in found if one.score > 0.5]
