"""Targets, augmentation, loss and run of the segmentation training."""

import numpy as np
import pytest
import torch
from rich.console import Console

from autonomy.perception.segmentation.network import CHANNELS, MAPS, OFFSET_PX, STRIDE, interface_of, network_input
from tests.training.drawn_logs import perfect_maps, picture
from training.common.loop import Schedule
from training.common.weight_file import parameter_count
from training.detection import segmentation
from training.detection.augmentation import augmented, recoloured
from training.detection.networks import UNet
from training.detection.segmentation import batches, loss, run, targets
from training.pictures.labels import IGNORED

LOGS = (((90.0, 100.0), 0.4, 120, 14), ((140.0, 120.0), 1.2, 100, 16))


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(segmentation, "CROPS", ((64, 1.0), (80, 1.0)))


def test_targets_point_to_the_centre_and_along_the_axis():
    sample = picture(*LOGS, size=208)
    maps, weights = targets(sample)
    assert maps.shape == (len(MAPS), 104, 104)
    y, x = 50, 45  # of the first log
    assert sample.ids[STRIDE * y, STRIDE * x] == 1
    centre = sample.logs[0, 1:3]
    at = np.array([x, y]) * STRIDE + 0.5 * (STRIDE - 1)
    assert at + OFFSET_PX * maps[2:4, y, x] == pytest.approx(centre, abs=1e-3)
    assert 0.5 * np.arctan2(maps[5, y, x], maps[4, y, x]) == pytest.approx(0.4, abs=1e-3)
    peak = np.unravel_index(np.argmax(maps[1]), maps[1].shape)
    assert min(np.hypot(*(np.array(peak[::-1]) * STRIDE - c)) for c in sample.logs[:, 1:3]) < 2.0
    assert weights[1][maps[0] == 0].sum() == 0.0


def test_ignored_pixels_have_no_weight():
    sample = picture(*LOGS, size=208)
    sample.ids[sample.ids == 2] = IGNORED
    maps, weights = targets(sample)
    assert weights[0][60, 70] == 0.0 and maps[0][60, 70] == 0.0


def test_a_perfect_net_has_the_lowest_loss():
    sample = picture(*LOGS, size=208)
    maps, weights = (torch.from_numpy(a[None]) for a in targets(sample))
    perfect = torch.from_numpy(perfect_maps(maps[0].numpy())[None])

    def value(out):
        return loss(lambda _: out, perfect, maps, weights).item()

    assert value(perfect) < 0.5  # soft outlines cost something even so
    for i in range(len(MAPS)):
        worse = perfect.clone()
        worse[:, i] = worse[:, i].flip(-1)
        assert value(worse) > value(perfect) + 0.01, MAPS[i]


def test_augmentation_depends_only_on_the_generator():
    sample = picture(*LOGS, size=208)
    one, two = (augmented(sample, np.random.default_rng(7), 96) for _ in range(2))
    assert np.array_equal(one.rgb, two.rgb) and one.ids.shape == (96, 96)
    assert one.logs.shape[0] > 0
    many = {augmented(sample, np.random.default_rng(s), 96).rgb.tobytes() for s in range(6)}
    assert len(many) == 6


def test_grey_stays_grey_under_changes_of_hue_and_saturation():
    rng = np.random.default_rng(1)
    grey = np.full((8, 8, 3), 120, np.uint8)
    spread = [np.ptp(recoloured(grey, rng).astype(int).mean(axis=(0, 1))) for _ in range(30)]
    assert max(spread) < 120 * 0.8  # gains of the network_input alone part them


def test_networks_are_small_and_accept_the_input():
    sample = picture(((50.0, 50.0), 0.4, 60, 10), size=96)
    for variant, width in CHANNELS.items():
        assert network_input(sample.rgb, sample.depth_m, sample.intrinsics, variant).shape == (width, 96, 96)
        assert interface_of(variant).channels == width
        assert parameter_count(UNet(variant)) < 500_000


@pytest.mark.long
def test_a_few_steps_reduce_the_loss_deterministically(small):
    torch.set_num_threads(1)  # sums of another order are other sums
    samples = [picture(((60.0 + 9 * i, 80.0), 0.3 * i, 90, 14), size=160) for i in range(4)]

    def once():
        return run(samples.__getitem__, 4, "depth", Schedule(8, 3e-3), 2, 5, None, Console(stderr=True, quiet=True))[1]

    first = once()
    assert np.mean(first[-2:]) < 0.9 * np.mean(first[:2])
    assert once() == first


def test_a_batch_depends_only_on_its_number(small):
    torch.set_num_threads(1)  # sums of another order are other sums
    samples = [picture(((60.0 + 9 * i, 80.0), 0.3 * i, 90, 14), size=160) for i in range(4)]
    batch = batches(samples.__getitem__, 4, 2, "rgbd", 0)
    later = batch(3)[0]
    batch(0)
    assert torch.equal(batch(3)[0], later)
    assert not torch.equal(batch(2)[0], later)
