"""Path-traced pictures: scenes from piles, shapes, the own tracer, samples on disk."""

import shutil
import sys

import numpy as np
import pytest

from training.pictures.piles import settle
from training.pictures.traced.scenes import Format, describe
from training.pictures.traced.tracer import Tracer, library


@pytest.fixture(scope="module")
def scene():
    return describe(settle("palms_471", 5), 3, Format(size_px=48, samples=1, views=1, stereo_share=0.0))


@pytest.mark.skipif(shutil.which("g++") is None, reason="the tracer needs g++")
def test_the_tracer_draws_light_depth_and_numbers(scene, tmp_path):
    tracer = Tracer(library(tmp_path), scene)
    light, depth, ids = tracer.draw(scene["views"][0], 1)
    tracer.close()
    assert np.isfinite(light).all() and np.nanmin(depth) > 0.3
    assert set(np.unique(ids)) <= {0, *(log["number"] for log in scene["logs"])} and ids.any()


@pytest.mark.skipif(shutil.which("g++") is None, reason="the tracer needs g++")
def test_loading_the_tracer_leaves_subnormal_numbers_as_they_are(tmp_path):
    library(tmp_path)
    assert sys.float_info.min * float("0.5") > 0.0
