"""The dominant plane of a picture and the heights over it."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.perception.segmentation.ground_plane import height_over_plane
from machine.geometry.optics import Intrinsics
from tests.training.drawn_logs import ground_depth

PIN = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)


@settings(max_examples=20, deadline=None)
@given(height=st.floats(1.5, 4.0), pitch=st.floats(0.6, 1.5), share=st.floats(0.0, 0.3))
def test_heights_are_over_the_ground_with_objects_on_it(height, pitch, share):
    ground = ground_depth(PIN, height, pitch)
    depth = ground.copy()
    columns = round(share * PIN.width_px)
    # A block of 0.4 m: its top is a plane 0.4 m nearer.
    depth[:, :columns] *= (height - 0.4) / height
    found = height_over_plane(depth, PIN)
    assert np.abs(found[:, columns:]).max() < 0.03
    assert columns == 0 or np.abs(found[:, :columns] - 0.4).max() < 0.04


def test_unknown_stays_unknown_and_noise_is_tolerated():
    rng = np.random.default_rng(4)
    depth = ground_depth(PIN).copy()
    depth += 0.01 * rng.standard_normal(depth.shape).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = np.nan
    found = height_over_plane(depth, PIN)
    assert np.array_equal(np.isnan(found), np.isnan(depth))
    assert abs(float(np.nanmedian(found))) < 0.01


def test_without_depth_heights_are_unknown():
    assert np.isnan(height_over_plane(np.full((120, 160), np.nan, np.float32), PIN)).all()


def test_too_few_points_give_the_plane_across_the_view():
    depth = np.full((120, 160), np.nan, np.float32)
    depth[60, 80] = 2.0
    assert math.isclose(float(height_over_plane(depth, PIN)[60, 80]), -1.0, abs_tol=1e-3)
