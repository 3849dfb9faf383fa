"""One approach with both pipelines on the same frames, or single frames over angle and range, as plain data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from autonomy.perception import papers
from autonomy.perception.camera.frame import Pose, RgbdFrame
from autonomy.perception.fitting.measure import Masked
from autonomy.perception.log_detector import Perception
from autonomy.perception.papers import (
    DETECTOR_PX,
    MAX_ASSOCIATION_M,
    Box,
    RunningAverage,
    box_in_picture,
    centres_of,
    position_in_box,
)
from autonomy.perception.tracking.log_filter import SURVEYED_BY_GNSS, Track
from experiments.common.pool import Job
from experiments.common.worlds import profile_named
from experiments.log_localization.site import APART_M, STOP_M, Shape, Shot, Site

MAX_RANGE_M: Final = 10.0  # beyond it a log is less than 6 px wide in the detector's picture
STEP_M: Final = 0.55  # between two positions of the approach
FRAMES_PER_POSITION: Final = 3  # rendering is slow, noise is not
FRAMES_PER_STOP: Final = 15  # one second
RATE_NS: Final = 66_666_667
MIN_MASK_PX: Final = 60  # smaller masks are ignored
MEAN_RADIUS_M: Final = 0.125  # of paper B's logs
FOUND_M: Final = 1.0  # an estimate farther from a log does not belong to it
RANGES_M: Final = (3.0, 4.0, 5.0, 6.0, 7.0, 8.0)
HISTOGRAM_BIN_M: Final = 0.05  # as in Fig. 17 of paper B

Segmenter = Callable[[RgbdFrame, Shot], Sequence[Masked]]


@dataclass(frozen=True, slots=True)
class TrueMask:
    """A mask of the renderer."""

    mask: np.ndarray


def true_masks(frame: RgbdFrame, shot: Shot) -> list[TrueMask]:
    """Return the masks of the renderer."""
    mask = shot.picture.mask
    masks = [TrueMask(mask == i) for i in np.unique(mask) if 0 < i < 1000]
    return [m for m in masks if np.count_nonzero(m.mask) >= MIN_MASK_PX]


def network_masks(frame: RgbdFrame, shot: Shot) -> Sequence[Masked]:
    """Compute the masks of the shipped network."""
    from autonomy.perception.segmentation.log_segmenter import segment

    return segment(frame)


SEGMENTERS: Final[dict[str, Segmenter]] = {"true": true_masks, "network": network_masks}


def perform(job: Job) -> dict[str, Any]:
    """Run one job."""
    o = job.options
    site = Site(profile_named(o["profile"]), o["truth"], job.seed, o["degrees"], 1 if job.kind == "curve" else 2)
    try:
        if job.kind == "curve":
            return _curve(site, SEGMENTERS[o["masks"]])
        return approach(site, SEGMENTERS[o["masks"]])
    finally:
        site.close()


def approach(site: Site, segment: Segmenter) -> dict[str, Any]:
    """Approach log 1, stop, remove it, approach log 2: errors of each log at its stop."""
    ours = Perception(site.profile, SURVEYED_BY_GNSS)
    faithful, centred = RunningAverage(), RunningAverage(MEAN_RADIUS_M)
    observations: list[np.ndarray] = []
    clock, out = 0, []
    start = -MAX_RANGE_M
    for number, log in enumerate(site.logs):
        stop = number * APART_M - STOP_M
        drive = [site.shot(float(x), number) for x in np.arange(start, stop, STEP_M)]
        standing = site.shot(stop, number)
        tracks: tuple[Track, ...] = ()
        for shot in [*(d for d in drive for _ in range(FRAMES_PER_POSITION)), *[standing] * FRAMES_PER_STOP]:
            clock += RATE_NS
            frame = site.frame(shot, clock)
            instances, pose = _near(frame, segment(frame, shot)), site.estimated_pose(shot)
            tracks = ours.step(frame, pose, instances)
            boxes = [detected(frame, i.mask) for i in instances]
            faithful.add(frame, pose, boxes)
            centred.add(frame, pose, boxes)
            observations += centres_of(frame, pose, boxes, MEAN_RADIUS_M)
        mask = _mask_of(log, number, standing, instances)
        row = _log_errors(log, tracks, faithful.positions_m(), centred.positions_m(), frame, pose, mask)
        out.append(row | {"faithful_peak_m": peak_error_m(observations, log.center_m, site.logs[0].center_m)})
        observations.clear()
        start = stop + STEP_M
    return {"logs": out}


def peak_error_m(observations: Sequence[np.ndarray], center_m: np.ndarray, origin_m: np.ndarray) -> float:
    """Compute paper B's own error of a log [m] (5.1.2, Fig. 17); NaN without an observation near the log.

    Every observation (3,) gives a horizontal distance from the origin, which is log 1; the error is that of the peak of
    their histogram.
    """
    near = [p for p in observations if np.linalg.norm(p - center_m) < MAX_ASSOCIATION_M]
    if not near:
        return math.nan
    bins = np.floor(np.linalg.norm((np.array(near) - origin_m)[:, :2], axis=1) / HISTOGRAM_BIN_M).astype(int)
    peak_m = (int(np.bincount(bins).argmax()) + 0.5) * HISTOGRAM_BIN_M
    return abs(peak_m - float(np.linalg.norm((center_m - origin_m)[:2])))


def _near(frame: RgbdFrame, instances: Sequence[Masked]) -> list[Masked]:
    """Select the instances within range."""
    near_instances = []
    for instance in instances:
        z = frame.depth_m[instance.mask]
        z = z[np.isfinite(z)]
        if len(z) and float(np.median(z)) < MAX_RANGE_M:
            near_instances.append(instance)
    return near_instances


def detected(frame: RgbdFrame, mask: np.ndarray) -> Box:
    """Compute the box of a perfect detector: whole pixels of its letterbox, in pixels of the frame."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    letterbox = frame.intrinsics.letterbox(DETECTOR_PX)
    scale = letterbox.inner.width_px / frame.intrinsics.width_px
    at_u, at_v = letterbox.left_px, letterbox.top_px
    left, right = columns[0] * scale + at_u, (columns[-1] + 1) * scale + at_u
    top, bottom = rows[0] * scale + at_v, (rows[-1] + 1) * scale + at_v
    return box_in_picture((round(left), round(top), round(right), round(bottom)), frame.intrinsics)


def _mask_of(log: Shape, number: int, shot: Shot, instances: Sequence[Masked]) -> np.ndarray | None:
    """Find the mask with most pixels of a log; None without one."""
    truth = shot.picture.mask == log.pose.instance
    shares = [np.count_nonzero(truth & i.mask) for i in instances]
    return instances[int(np.argmax(shares))].mask if shares and max(shares) > 0 else None


def _log_errors(
    log: Shape,
    tracks: Sequence[Track],
    positions: list[np.ndarray],
    centred: list[np.ndarray],
    frame: RgbdFrame,
    pose: Pose,
    mask: np.ndarray | None,
) -> dict[str, Any]:
    """Compute the errors of one log; NaN if it was not found."""
    out: dict[str, Any] = dict.fromkeys(
        (
            "error_m",
            "axis_deg",
            "diameter_m",
            "length_m",
            "nees",
            "faithful_error_m",
            "faithful_centred_m",
            "faithful_axis_deg",
            "faithful_diameter_m",
            "faithful_length_m",
        ),
        math.nan,
    )
    if tracks:
        estimate = min((t.estimate for t in tracks), key=lambda e: float(np.linalg.norm(e.center_m - log.center_m)))
        miss = estimate.center_m - log.center_m
        if np.linalg.norm(miss) < FOUND_M:
            out["error_m"] = float(np.linalg.norm(miss))
            out["axis_deg"] = _degrees(estimate.axis, log.axis)
            out["diameter_m"] = abs(estimate.diameter_m - log.pose.diameter_m)
            if all(estimate.ends_seen):
                out["length_m"] = abs(estimate.length_m - log.pose.length_m)
            parts = np.array([miss @ e for e in (*estimate.frame(), estimate.axis)])
            out["nees"] = float(np.mean((parts / estimate.position_sigma_m()) ** 2))
            out["parts_m"] = [float(v) for v in parts]
    for key, places in (("faithful_error_m", positions), ("faithful_centred_m", centred)):
        apart = [float(np.linalg.norm(p - log.center_m)) for p in places]
        if apart and min(apart) < FOUND_M:
            out[key] = min(apart)
    plain = papers.log_from_mask(frame, mask) if mask is not None else None
    if plain is not None:
        out["faithful_axis_deg"] = _degrees(pose.rotation @ plain.axis, log.axis)
        out["faithful_diameter_m"] = abs(plain.diameter_m - log.pose.diameter_m)
        out["faithful_length_m"] = abs(plain.length_m - log.pose.length_m)
    return out


def _curve(site: Site, segment: Segmenter) -> dict[str, Any]:
    """Measure the errors of single frames at each of ``RANGES_M``, by our and by the paper's pipeline."""
    perception, log = Perception(site.profile), site.logs[0]
    ours, faithful = [], []
    for range_m in RANGES_M:
        shot = site.single(range_m)
        frame = site.frame(shot, 0)
        instances = segment(frame, shot)
        fits = perception.fits(frame, instances)
        apart = [float(np.linalg.norm(shot.view.to_world(f.body.center_m) - log.center_m)) for f in fits]
        ours.append(min(apart, default=math.nan))
        points = [position_in_box(frame, detected(frame, i.mask)) for i in instances]
        apart = [float(np.linalg.norm(shot.view.to_world(p) - log.center_m)) for p in points if p is not None]
        faithful.append(min(apart, default=math.nan))
    return {"ours": ours, "faithful": faithful}


def _degrees(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(min(1.0, abs(float(a @ b)))))
