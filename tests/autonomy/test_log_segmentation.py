"""Instances from maps, kernels and merged segments, the scales of segmented pictures, and heights over the ground."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.perception.camera.frame import RgbdFrame, content_window
from autonomy.perception.segmentation.ground_plane import height_over_plane
from autonomy.perception.segmentation.instances import decode_instances, foreground_of
from autonomy.perception.segmentation.log_segmenter import LogSegmenter, fuse_scales
from autonomy.perception.segmentation.mask_network import FEATURES, KERNEL, mask_input
from autonomy.perception.segmentation.mask_segmenter import MaskSegmenter, decoded, kernel_logs
from autonomy.perception.segmentation.network import COS2, MAPS, MASK, OFFSET_PX, STRIDE, interface_of
from autonomy.perception.segmentation.resize import bilinear, doubled, interpolated_map, shrunk
from autonomy.perception.segmentation.segment_merging import (
    SegmentMerger,
    load_scorers,
    over_segment,
    segment_logs,
    shipped_scorers,
)
from autonomy.perception.segmentation.segment_pairs import PAIR_FEATURES, SegmentTable, pair_features
from autonomy.perception.segmentation.segments import SEGMENT_FEATURES, boundary_map, make_segment, watershed
from machine.geometry.optics import Intrinsics
from runtime.errors import InputRefused
from tests.codes import coded
from tests.training.drawn_logs import ground_depth, perfect_maps, picture
from training.common.loop import seeded
from training.common.weight_file import save
from training.detection.networks import UNet
from training.detection.scorer_weights import merge_examples, quality_examples
from training.detection.segmentation import targets

CROSSED = (((80, 80), 0.3, 100, 12), ((80, 80), 1.7, 90, 12))
PARALLEL = (((80, 60), 0.2, 100, 12), ((80, 73), 0.2, 100, 12), ((80, 86), 0.2, 100, 12))


def found(*logs, size=160):
    sample = picture(*logs, size=size)
    maps, _ = targets(sample)
    return sample, decode_instances(perfect_maps(maps), STRIDE, sample.depth_m, shipped_scorers())


def overlap(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


@pytest.mark.parametrize("logs", [CROSSED, PARALLEL, CROSSED[:1]], ids=["crossed", "parallel", "single"])
def test_every_log_is_one_instance(logs):
    sample, out = found(*logs)
    assert len(out) == len(logs)
    for number in range(1, len(logs) + 1):
        assert max(overlap(i.mask, sample.ids == number) for i in out) > 0.85


@settings(max_examples=25, deadline=None)
@given(angle=st.floats(-1.5, 1.5), length=st.floats(40, 120), width=st.floats(8, 16))
def test_axis_box_and_ends_are_those_of_the_log(angle, length, width):
    sample, (log,) = found(((80.0, 80.0), angle, length, width))
    assert abs(math.remainder(log.axis_px - angle, math.pi)) < 0.03
    v, u = np.nonzero(sample.ids)
    assert np.abs(np.array(log.box_px) - (u.min(), v.min(), u.max() + 1, v.max() + 1)).max() <= 2
    half = length / 2 * np.array([math.cos(angle), math.sin(angle)])
    ends = sorted(log.ends_px), sorted([tuple(80.0 - half), tuple(80.0 + half)])
    assert np.abs(np.array(ends[0]) - ends[1]).max() < 2.5
    assert log.ends_seen == (True, True)


def test_two_scales_are_fused():
    logs = (((160, 120), 0.2, 200, 24), ((160, 146), 0.2, 200, 24), ((200, 140), 1.5, 180, 20))
    fine = picture(*logs, size=320)
    small = [((u / 2, v / 2), angle, length / 2, width / 2) for (u, v), angle, length, width in logs]
    scales = [perfect_maps(targets(s)[0]) for s in (fine, picture(*small, size=160))]
    scales[0][2:4] = 0.0  # fine maps need not know the centre
    out = decode_instances(fuse_scales(*scales), STRIDE, fine.depth_m, shipped_scorers())
    assert len(out) == 3
    for number in (1, 2, 3):
        assert max(overlap(i.mask, fine.ids == number) for i in out) > 0.85


def test_an_end_outside_the_picture_is_not_seen():
    _, (log,) = found(((10.0, 80.0), 0.0, 120, 14))
    assert log.ends_seen == (False, True)
    assert log.box_px[0] == 0


def test_isolated_pixels_are_not_in_the_mask_of_a_log():
    sample = picture(((80.0, 80.0), 0.8, 110, 12))
    maps = perfect_maps(targets(sample)[0])
    maps[0, 30, 50] = maps[0, 5, 75] = 5.0  # in the log's box and outside it
    (log,) = decode_instances(maps, STRIDE, sample.depth_m, shipped_scorers())
    assert not log.mask[60, 100] and not log.mask[10, 150]
    assert overlap(log.mask, sample.ids == 1) > 0.85


def test_maps_without_logs_give_no_instance():
    maps = np.zeros((8, 40, 40), np.float32)
    maps[0] = -5.0
    assert decode_instances(maps, 4, np.full((160, 160), np.nan, np.float32), shipped_scorers()) == ()


def test_the_outline_of_a_coarse_map_runs_between_its_pixels():
    sample, (log,) = found(((80.0, 80.0), 0.5, 100, 14))
    depth = sample.depth_m.repeat(2, axis=0).repeat(2, axis=1)
    (fine,) = decode_instances(perfect_maps(targets(sample)[0]), 4, depth, shipped_scorers())
    assert abs(np.count_nonzero(fine.mask) / (4.0 * np.count_nonzero(sample.ids)) - 1.0) < 0.06
    assert np.abs(np.array(fine.box_px) / 2.0 - log.box_px).max() <= 1.0


def test_letterbox_bars_are_removed_and_a_black_picture_is_kept_whole():
    rgb = np.zeros((40, 40, 3), np.uint8)
    assert content_window(rgb) == (0, 40, 0, 40)
    rgb[9:31] = 5
    assert content_window(rgb) == (9, 31, 0, 40)


def test_a_shrunk_pixel_has_the_ray_of_its_block_centre():
    pin = Intrinsics(12, 6, 10.0, 10.0, 5.5, 2.5)
    rgb = np.arange(12 * 6 * 3, dtype=np.uint8).reshape(6, 12, 3)
    small, depth, lens = shrunk(rgb, np.arange(72, dtype=np.float32).reshape(6, 12), pin, 3)
    assert small.shape == (2, 4, 3) and depth.shape == (2, 4)
    assert depth[0, 0] == 13.0  # row 1, column 1
    assert small[0, 0, 0] == int(rgb[:3, :3, 0].mean())
    # The ray of the small pixel 0 is that of the middle of pixels 0, 1, 2.
    assert (0 - lens.cx_px) / lens.fx_px == pytest.approx((1 - pin.cx_px) / pin.fx_px)


def test_a_doubled_picture_shrinks_to_itself():
    pin = Intrinsics(12, 6, 10.0, 10.0, 5.5, 2.5)
    rgb = np.linspace(0, 250, 216).astype(np.uint8).reshape(6, 12, 3)
    depth = np.arange(72, dtype=np.float32).reshape(6, 12)
    large = doubled(rgb, depth, pin)
    assert large[0].shape == (12, 24, 3) and large[0][0, 0, 0] == rgb[0, 0, 0]
    again, near, lens = shrunk(*large, 2)
    assert np.abs(again[1:-1, 1:-1].astype(int) - rgb[1:-1, 1:-1]).max() <= 2
    assert np.array_equal(near, depth) and lens == pin


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "logs.onnx"
    save(path, seeded(lambda: UNet("rgbd"), 3), interface_of("rgbd"), {})
    return path


def test_masks_have_the_size_of_the_picture(untrained):
    for shape, size_px in (((70, 101), 96), ((192, 192), 96), ((70, 101), 200), ((340, 480), 480)):
        segmenter = LogSegmenter("rgbd", untrained, size_px=size_px)
        rgb = np.full((*shape, 3), 80, np.uint8)
        rgb[:10] = 0
        depth = np.full(shape, 3.0, np.float32)
        pin = Intrinsics(shape[1], shape[0], 90.0, 90.0, shape[1] / 2, shape[0] / 2)
        for log in segmenter.segment_picture(rgb, depth, pin):
            assert log.mask.shape == shape
            assert not log.mask[:9].any()


class Recorded(LogSegmenter):
    """A segmenter whose network sees wood where a picture is bright; it records the sizes of its pictures."""

    def maps(self, rgb, depth_m, pinhole):
        self.sizes = [*getattr(self, "sizes", []), rgb.shape[:2]]
        maps = np.zeros((8, -(-rgb.shape[0] // STRIDE), -(-rgb.shape[1] // STRIDE)), np.float32)
        wood = rgb[::STRIDE, ::STRIDE, 0] > 128
        maps[0], maps[4], maps[7] = np.where(wood, 9.0, -9.0), 1.0, -9.0
        v, u = np.nonzero(wood)
        middle = (0.0, 0.0) if not len(u) else (u.mean(), v.mean())
        maps[2], maps[3] = (
            (m - g) * STRIDE / OFFSET_PX
            for m, g in zip(middle, np.mgrid[: wood.shape[0], : wood.shape[1]][::-1], strict=True)
        )
        return maps


def bright(top, left, high, wide, shape=(720, 1280)):
    rgb = np.full((*shape, 3), 40, np.uint8)
    rgb[top : top + high, left : left + wide] = 200
    pin = Intrinsics(shape[1], shape[0], 600.0, 600.0, shape[1] / 2, shape[0] / 2)
    return rgb, np.full(shape, 4.0, np.float32), pin


@pytest.mark.parametrize(
    ("log", "largest"),
    [
        ((400, 900, 40, 300), (352, 608)),
        ((100, 900, 520, 40), (608, 352)),
        ((300, 600, 12, 80), (352, 608)),
        ((300, 20, 40, 1200), (360, 640)),
    ],
    ids=["in a part", "upright", "small, doubled", "across the picture"],
)
def test_a_window_around_the_wood_is_segmented_at_a_finer_scale(untrained, log, largest):
    segmenter = Recorded("rgbd", untrained)
    (seen,) = segmenter.segment_picture(*bright(*log))
    assert max(segmenter.sizes, key=math.prod) == largest
    top, left, high, wide = log
    assert np.abs(np.array(seen.box_px) - (left, top, left + wide, top + high)).max() <= 4
    assert seen.mask.shape == (720, 1280) and seen.mask[top + high // 2, left + wide // 2]
    segmenter = Recorded("rgbd", untrained, use_window=False)
    segmenter.segment_picture(*bright(*log))
    assert segmenter.sizes == [(180, 320), (360, 640)] or segmenter.sizes == [(360, 640), (180, 320)]


def test_the_window_stays_in_the_picture(untrained):
    segmenter = Recorded("rgbd", untrained)
    (seen,) = segmenter.segment_picture(*bright(0, 0, 40, 260))
    assert np.abs(np.array(seen.box_px) - (0, 0, 260, 40)).max() <= 4
    assert segmenter.segment_picture(*bright(0, 0, 0, 0)) == ()


class CoarselyBlind(Recorded):
    """Its coarse view shows wood in a patch at the right only."""

    def maps(self, rgb, depth_m, pinhole):
        maps = super().maps(rgb, depth_m, pinhole)
        if rgb.shape[:2] == (180, 320):
            maps[0], maps[0, 40:44, 140:150] = -9.0, 1.0
        return maps


def test_a_log_too_thin_for_the_coarse_view_is_segmented(untrained):
    segmenter = CoarselyBlind("rgbd", untrained)
    (seen,) = segmenter.segment_picture(*bright(500, 100, 14, 300))
    assert (360, 640) in segmenter.sizes and (352, 608) in segmenter.sizes, "the window held no log"
    assert np.abs(np.array(seen.box_px) - (100, 500, 400, 514)).max() <= 6
    assert segmenter.segment_picture(*bright(400, 20, 60, 260)) == (), "the coarse view is trusted for thick logs"


def test_invalid_frames_are_refused(untrained):
    segmenter = LogSegmenter("rgbd", untrained, size_px=96)
    pin = Intrinsics(64, 64, 60.0, 60.0, 31.5, 31.5)
    blind = RgbdFrame("stick", 0, np.zeros((64, 64, 3), np.uint8), np.full((64, 64), np.nan, np.float32), pin)
    with pytest.raises(InputRefused, check=coded("frame.depth-unknown")):
        segmenter.segment(blind)


def test_corrupt_or_foreign_weights_are_refused(untrained, tmp_path):
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(untrained.read_bytes()[:5000])
    with pytest.raises(InputRefused):
        LogSegmenter("rgbd", cut)
    with pytest.raises(InputRefused, check=coded("weights.other-network")):
        LogSegmenter("depth", untrained)


@pytest.mark.parametrize("shape", [(7, 12), (1, 3), (3, 1), (2, 2)])
def test_a_map_is_interpolated_as_by_the_matrices(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    by_matrices = bilinear(shape[0], 2) @ values @ bilinear(shape[1], 2).T
    assert interpolated_map(values) == pytest.approx(by_matrices, abs=1e-6)


# -- the mask network
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


@pytest.mark.parametrize("mode", ["rgbd", "colour", "depth"])
def test_bare_ground_shows_no_log(mode):
    rng = np.random.default_rng(0)
    rgb = rng.integers(60, 90, (192, 256, 3)).astype(np.uint8)
    found = MaskSegmenter(mode).segment_picture(
        rgb, np.full((192, 256), 3.0, np.float32), Intrinsics(256, 192, 200, 200, 128, 96)
    )
    assert not [one for one in found if one.score > 0.5]


# -- heights over the ground
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


# -- segments split by boundaries, and segments that are one log
ROOM = np.ones((20, 60), bool)


def walled(height):
    """Two basins of height 0.1 with a boundary of ``height`` between them in row 10."""
    boundary = np.full(ROOM.shape, 0.1)
    boundary[10] = height
    return boundary


def test_a_strong_boundary_splits_and_a_weak_one_does_not():
    labels = watershed(walled(0.6), ROOM)
    assert len(np.unique(labels[:10])) == len(np.unique(labels[11:])) == 1
    assert labels[0, 0] != labels[19, 0] and labels.all()
    assert len(np.unique(watershed(walled(0.14), ROOM))) == 1


def test_a_shallow_basin_joins_the_deep_one_that_it_meets():
    boundary = walled(0.6)
    boundary[11:] = 0.5  # a step of the boundary, not a basin of its own
    assert len(np.unique(watershed(boundary, ROOM))) == 1


def test_three_basins_stay_separate_where_they_meet():
    boundary = walled(0.7)
    boundary[:10, 30] = 0.7
    labels = watershed(boundary, ROOM)
    assert len({labels[0, 0], labels[0, 59], labels[19, 30]}) == 3


def test_nothing_outside_the_foreground_is_labelled():
    some = ROOM.copy()
    some[:, 20:30] = False
    labels = watershed(walled(0.1), some)
    assert not labels[:, 20:30].any() and labels[0, 0] != labels[0, 59]
    assert not watershed(walled(0.1), np.zeros_like(ROOM)).any()


def test_an_isolated_pixel_is_not_labelled():
    some = ROOM.copy()
    some[:, 50:] = False
    some[3, 55] = True
    labels = watershed(walled(0.6), some)
    assert labels[3, 55] == 0 and labels[some].astype(bool).sum() == some.sum() - 1


def foreground_of_logs(*logs):
    """The foreground of perfect maps, and the log of every pixel of the maps."""
    sample = picture(*logs, size=208)
    foreground = foreground_of(perfect_maps(targets(sample)[0]), STRIDE, sample.depth_m)
    return foreground, sample.ids[1::STRIDE, 1::STRIDE].astype(int)


def logs_of(*logs):
    return segment_logs(foreground_of_logs(*logs)[0], shipped_scorers())


@pytest.mark.parametrize("away", [30.0, 60.0])
def test_a_log_that_another_crosses_is_one_log(away):
    assert len(logs_of(((100, 100), 0.3, 150, 16), ((100 + away / 2, 100), 1.7, 120, 16))) == 2


def test_two_logs_in_line_stay_two():
    assert len(logs_of(((60, 100), 0.0, 80, 14), ((150, 100), 0.0, 80, 14))) == 2  # ground between them
    assert len(logs_of(((60, 100), 0.0, 80, 14), ((141, 100), 0.0, 80, 14))) == 2  # they touch, but vote apart


def test_logs_are_ordered_by_size_and_share_no_pixel():
    found = logs_of(((60, 60), 0.2, 60, 12), ((120, 140), 0.4, 120, 18))
    assert len(found[0].members) > len(found[1].members)
    assert abs(np.arctan2(found[0].axis[1], found[0].axis[0]) - 0.4) < 0.02
    assert len(np.unique(np.concatenate([r.members for r in found]))) == sum(len(r.members) for r in found)


LONG_CROSSED = (((100, 100), 0.3, 150, 16), ((115, 100), 1.7, 120, 16))


def related(foreground, a, b, touch=0.0):
    big, small = (SegmentTable.of([make_segment(foreground, np.flatnonzero(members))]) for members in (a, b))
    features = pair_features(foreground, big, small, np.array([touch]), np.zeros(1))
    return dict(zip(PAIR_FEATURES, features[0].tolist(), strict=True))


def test_a_turn_of_the_axis_is_a_boundary_without_an_edge():
    maps = np.zeros((8, 20, 40), np.float32)
    maps[7] = -9.0
    maps[4, :, :20], maps[5, :, 20:] = 1.0, 1.0
    high = boundary_map(maps)
    assert (high[:, 19:21] > 0.4).all() and (high[:, :18] < 0.01).all()


def test_both_parts_of_a_crossed_log_are_on_one_line_in_depth():
    foreground, ids = foreground_of_logs(*LONG_CROSSED)
    of = ids[foreground.y, foreground.x] == 1
    left, right = of & (foreground.x < 45), of & (foreground.x > 65)
    features = related(foreground, left, right)
    assert features["depth_known"] == 1.0 and features["depth_difference"] < 0.3
    assert features["gap"] > 0.1 and features["gap_background"] == 0.0 and features["turn"] < 0.1


def test_a_gap_behind_an_occluder_is_not_background():
    foreground, ids = foreground_of_logs(((60, 100), 0.0, 60, 14), ((150, 100), 0.0, 60, 14))
    members = [ids[foreground.y, foreground.x] == i for i in (1, 2)]
    assert related(foreground, *members)["gap_background"] > 0.9
    foreground.inverse[:, 46:60] *= 1.2  # a post before both
    assert related(foreground, *members)["gap_background"] < 0.4


def test_a_merged_segment_has_the_borders_of_both():
    foreground, _ = foreground_of_logs(*LONG_CROSSED)
    merger = SegmentMerger(foreground, over_segment(foreground))
    touch = merger._border_px.copy()
    n = len(merger.segments)
    merger.merge_pair(0, n - 1)
    assert len(merger.segments) == n - 1
    assert merger._border_px[0, 1] == touch[0, 1] + touch[n - 1, 1] and merger._border_px[0, 0] == 0.0
    pairs, features = merger.pairs()
    fresh_pairs, fresh = SegmentMerger(foreground, merger.segments).pairs()
    assert np.array_equal(pairs, fresh_pairs)
    assert np.abs(features - fresh)[:, 3:].max() < 1e-6  # what does not depend on borders between the two


def test_examples_have_both_answers():
    foreground, ids = foreground_of_logs(*LONG_CROSSED)
    pairs = merge_examples(foreground, ids, np.random.default_rng(1))
    assert pairs.features.shape[1] == len(PAIR_FEATURES) and set(pairs.target) == {0.0, 1.0}
    whole = quality_examples(foreground, ids, shipped_scorers().merge)
    assert whole.features.shape == (2, len(SEGMENT_FEATURES)) and (whole.target > 0.85).all()


def test_a_picture_without_logs_has_no_segments():
    foreground, ids = foreground_of_logs()
    none = quality_examples(foreground, ids, shipped_scorers().merge)
    assert logs_of() == [] and none.features.shape == (0, len(SEGMENT_FEATURES)) and none.features.dtype == np.float32


def test_missing_scorers_are_refused(tmp_path):
    with pytest.raises(InputRefused, check=coded("weights.missing")):
        load_scorers(tmp_path)
