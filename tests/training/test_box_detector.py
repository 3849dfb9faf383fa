"""The box detector in the role of paper B's: decoding, targets, training, errors."""

import numpy as np
import pytest
import torch
from rich.console import Console

from autonomy.perception.papers import BOXES, SIZE_PX, BoxDetector, decode_boxes
from runtime.errors import InputRefused
from tests.codes import coded
from tests.training.drawn_logs import picture
from training.common.loop import Schedule, seeded
from training.common.weight_file import parameter_count, save
from training.detection import boxes
from training.detection.boxes import run, targets
from training.detection.networks import BoxNetwork

LOGS = (((60.0, 70.0), 0.4, 80, 14), ((140.0, 120.0), 1.2, 100, 16))


def perfect(maps):
    out = maps.copy()
    p = np.clip(maps[0], 1e-3, 1.0 - 1e-3)
    out[0] = np.log(p / (1.0 - p))
    return out


def test_boxes_of_perfect_maps_are_those_of_the_logs():
    sample = picture(*LOGS, size=208)
    found, scores = decode_boxes(perfect(targets(sample)[0]))
    assert len(found) == 2 and (scores > 0.9).all()
    for number in (1, 2):
        v, u = np.nonzero(sample.ids == number)
        box = (u.min(), v.min(), u.max() + 1, v.max() + 1)
        assert np.abs(found - box).max(axis=1).min() < 0.51


def test_duplicate_boxes_are_suppressed_and_neighbours_are_kept():
    maps = np.full((5, 30, 30), -9.0, np.float32)
    for x, score in ((10, 3.0), (12, 2.0), (20, 1.0)):
        maps[:, 10, x] = (score, *np.log([6.0, 3.0, 6.0, 3.0]))
    found, scores = decode_boxes(maps)
    assert len(found) == 3  # two steps of 8 px aside: overlap 0.71
    maps[1:, 10, 12] = np.log([7.0, 3.0, 5.0, 3.0])  # now the same box
    found, scores = decode_boxes(maps)
    assert len(found) == 2 and scores[0] > scores[1]


def test_empty_maps_give_no_boxes():
    found, scores = decode_boxes(np.full((5, 10, 10), -9.0, np.float32))
    assert found.shape == (0, 4) and scores.shape == (0,)


def test_pictures_of_another_size_and_foreign_weights_are_refused(tmp_path):
    path = tmp_path / "boxes.onnx"
    save(path, seeded(BoxNetwork, 1), BOXES, {})
    detector = BoxDetector(path)
    with pytest.raises(InputRefused, check=coded("network.bad-picture")):
        detector.detect(np.zeros((304, 304, 3), np.uint8))
    found, _ = detector.detect(np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8))
    assert found.shape[1] == 4
    with pytest.raises(InputRefused):
        BoxDetector(tmp_path / "none.onnx")
    assert parameter_count(BoxNetwork()) < 500_000


@pytest.mark.long
def test_a_few_steps_reduce_the_loss(monkeypatch):
    monkeypatch.setattr(boxes, "CROPS", ((64, 1.0),))
    samples = [picture(((60.0 + 9 * i, 80.0), 0.3 * i, 60, 14), size=160) for i in range(4)]
    _, losses = run([(samples.__getitem__, 4)], Schedule(10, 3e-3), 2, 5, None, Console(stderr=True, quiet=True))
    assert np.mean(losses[-3:]) < 0.8 * np.mean(losses[:2])


def test_the_generalised_overlap_of_two_boxes():
    """Of boxes about one cell: nothing of equal ones, a half of one in another of twice the size."""

    def box(*sides):
        return torch.log(torch.tensor(sides, dtype=torch.float32)).reshape(1, 4, 1, 1)

    def lacks(a, b):
        return boxes._giou_loss(a, b).item()

    one = box(2.0, 3.0, 2.0, 3.0)
    assert lacks(one, one) == pytest.approx(0.0, abs=1e-6)
    assert lacks(one, box(2.0, 3.0, 6.0, 3.0)) == pytest.approx(0.5)  # overlap a half, and it is all that is around
    left, right = box(4.0, 1.0, 0.05, 1.0), box(0.05, 1.0, 4.0, 1.0)
    assert lacks(left, right) == pytest.approx(1.0, abs=0.05), "beside each other they share next to nothing"


@pytest.mark.long
def test_training_starts_from_weights(tmp_path):
    sample = [picture(((90.0, 80.0), 0.3, 60, 14), size=304)]
    start = {name: values.numpy() for name, values in seeded(BoxNetwork, 7).state_dict().items()}
    quiet = Console(stderr=True, quiet=True)
    net, _ = run([(sample.__getitem__, 1)], Schedule(1, 1e-9), 2, 5, None, quiet, start)
    assert np.abs(net.boxes.weight.detach().numpy() - start["boxes.weight"]).max() < 1e-6
    other, _ = run([(sample.__getitem__, 1)], Schedule(1, 1e-9), 2, 5, None, quiet)
    assert np.abs(other.boxes.weight.detach().numpy() - start["boxes.weight"]).max() > 1e-3


def test_batches_of_small_and_large_pictures_alternate():
    small, large = ([picture(((90.0, 80.0), 0.3, 60, 14), size=size)] for size in (304, 608))
    batch = boxes.batches([(small.__getitem__, 1), (large.__getitem__, 1)], 8, 5)
    assert [batch(step)[0].shape for step in (0, 1, 2)] == [(8, 3, 256, 256), (2, 3, 512, 512), (8, 3, 256, 256)]
    assert batch(1)[1].shape == (2, 5, 64, 64)
