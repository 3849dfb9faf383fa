"""A tiny data set in COCO format, as TimberSeg 1.0."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.codes import coded
from training.common.dataset_error import DatasetError
from training.pictures.coco import _unpacked, labelled, load
from training.pictures.labels import IGNORED

POLYGON = [[10, 10, 70, 10, 70, 20, 10, 20]]


def data_set(folder, annotations):
    Image.new("RGB", (80, 40), (10, 200, 30)).save(folder / "a.png")
    document = {
        "images": [{"id": 7, "file_name": "a.png", "width": 80, "height": 40}],
        "annotations": [{"id": i, "image_id": 7, **a} for i, a in enumerate(annotations)],
        "categories": [{"id": 1, "name": "timber"}],
    }
    path = folder / "annotations.json"
    path.write_text(json.dumps(document))
    return path


def runs():
    """A 4 px wide, 20 px high strip at column 30, as plain run lengths down the columns."""
    mask = np.zeros((40, 80), bool)
    mask[15:35, 30:34] = True
    flat = mask.T.ravel()
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flat.astype(int), [0]])))
    lengths = np.diff(np.concatenate([[0], edges, [flat.size]]))
    return {"size": [40, 80], "counts": lengths.tolist()}


def packed(counts):
    """COCO's text form, after its own rleToString."""
    out = []
    for i, count in enumerate(counts):
        x = count - (counts[i - 2] if i > 2 else 0)
        more = True
        while more:
            c = x & 0x1F
            x >>= 5
            more = not ((x == -1 and c & 0x10) or (x == 0 and not c & 0x10))
            out.append(chr((c | 0x20 if more else c) + 48))
    return "".join(out)


@given(st.lists(st.integers(0, 100_000), min_size=1, max_size=12))
def test_packed_run_lengths_are_unpacked(counts):
    assert _unpacked(packed(counts)) == counts


def test_polygons_and_run_lengths_become_logs(tmp_path):
    whole = runs()
    text = {"size": whole["size"], "counts": packed(whole["counts"])}
    path = data_set(
        tmp_path,
        [{"segmentation": POLYGON}, {"segmentation": whole}, {"segmentation": text, "iscrowd": 1}],
    )
    (picture,) = load(path, tmp_path)
    only = labelled(picture.__class__(picture.path, 80, 40, picture.annotations[:2]), 160)
    assert only.rgb.shape == (160, 160, 3) and np.isnan(only.depth_m).all()
    assert not only.rgb[:40].any() and only.rgb[60, 60].tolist() == [10, 200, 30]
    v, u = np.nonzero(only.ids == 1)
    assert (u.min(), u.max(), v.min(), v.max()) == pytest.approx((20, 139, 60, 79), abs=1.5)
    v, u = np.nonzero(only.ids == 2)
    assert (u.min(), u.max(), v.min(), v.max()) == (60, 67, 70, 109)
    assert only.logs.shape[0] == 2
    every = labelled(picture, 160)  # the crowd has the place of the second
    assert (every.ids[70:110, 60:68] == IGNORED).all()


@pytest.mark.parametrize(
    "broken", [{}, {"segmentation": {"size": [40, 80], "counts": [5]}}, {"segmentation": [[1, 2, 3]]}]
)
def test_an_invalid_annotation_is_refused(tmp_path, broken):
    (picture,) = load(data_set(tmp_path, [broken]), tmp_path)
    with pytest.raises(DatasetError, check=coded("dataset.bad-annotation")):
        labelled(picture, 160)


def test_an_invalid_file_is_refused(tmp_path):
    with pytest.raises(DatasetError, check=coded("dataset.unreadable")):
        load(tmp_path / "none.json", tmp_path)
    (tmp_path / "x.json").write_text('{"images": 3}')
    with pytest.raises(DatasetError, check=coded("dataset.not-coco")):
        load(tmp_path / "x.json", tmp_path)
    path = data_set(tmp_path, [])
    (tmp_path / "a.png").unlink()
    with pytest.raises(DatasetError, check=coded("dataset.bad-picture")):
        labelled(load(path, tmp_path)[0], 160)
