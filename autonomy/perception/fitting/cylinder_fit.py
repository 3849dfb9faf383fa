"""Least-squares fit of a cylinder to the contour and the depth of a mask.

The fit adjusts seven numbers (across the view, along it, two tilts, both ends, radius) and the taper.  Contour points
must lie on the outline of the cylinder, and depth inside the mask must be that of its visible surface.  The loss is
robust (Cauchy).  Where something nearer cuts the mask, or at the edge of the picture, the contour is not the log's own.
Then:

- such contour points must only lie inside the cylinder;
- an end without contour of its own is not an end;
- a log with one visible side gets the mean radius of logs, and the covariance says so.

Stereo matching pulls depth near the border towards nearer objects, so depth there counts less.  Errors of neighbouring
points are correlated, so points count less than their number, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from autonomy.perception.fitting.contour import Contour, StereoSensor
from autonomy.perception.fitting.cylinder import (
    MIN_PIXELS,
    Cylinder,
    CylinderBatch,
    axial_positions,
    distance_and_depth,
    outline_distance,
    pixel_rays,
)
from autonomy.perception.log_list import END, HIDDEN_END_SIGMA_M, START
from machine.geometry.optics import Intrinsics

MAX_DEPTH_POINTS: Final = 80
OUTLINE_SIGMA_PX: Final = 0.6  # of the mask's border, and of bark and bow against a straight cylinder
DEPTH_CORRELATION_PX: Final = 17.7  # sqrt(pi) x 10 px: correlation length of stereo errors along a line
OUTLINE_CORRELATION_PX: Final = 5.0
FATTENING_PX: Final = 8  # width of the foreground fattening of stereo matching
FOREGROUND_BIAS_SIGMA_M: Final = 0.15  # of depth that stereo matching pulled to a nearer object
MEAN_RADIUS_M, RADIUS_SIGMA_M = 0.12, 0.05  # prior for a log with one visible side
MIN_OWN_SHARE: Final = 0.8  # below this share of own contour, one side of the log may be hidden
# Scales of the Cauchy loss, in standard deviations.
OUTLINE_CAUCHY_SCALE: Final = 3.0
DEPTH_CAUCHY_SCALE, NEAR_CAUCHY_SCALE = 2.5, 1.5
WIDE_SCALE_FACTOR: Final = 6.0  # of the second attempt
RETRY_EXPLAINED_SHARE: Final = 0.7  # share of the contour below which a fit is tried again
TAPER_SIGMA: Final = 0.006  # of the radius along a log [m/m]; it is unknown which end is the butt
BOW_SIGMA_SHARE: Final = 0.018  # rise of a log's arch over its length, in each direction
STRAIGHT_SIGMA_M: Final = 1e-4
MIN_RADIUS_M: Final = 0.01
MIN_LENGTH_M: Final = 0.05
MIN_DEPTH_M: Final = 0.1
MIN_OWN_POINTS: Final = 8  # of the contour
ARCH_ITERATIONS: Final = 2
MAX_ITERATIONS: Final = 14
CONVERGED_STEP2: Final = 0.1  # squared length of the last step, in standard deviations
DERIVATIVE_STEP: Final = 1e-3  # of the numerical derivatives [m, rad]
_EYE: Final = np.eye(8)
_STEPS: Final = np.concatenate([np.zeros((1, 8)), DERIVATIVE_STEP * _EYE])
_LONGER_STEPS: Final = np.zeros((3, 8))
_LONGER_STEPS[1, 4], _LONGER_STEPS[2, 5] = -0.5, 0.5
_MAX_STEP: Final = np.array([0.4, 0.6, 0.5, 0.5, 0.6, 0.6, 0.08, 0.02])  # of one iteration
# Systematic errors: of an outline, of an end, and of an end that is seen along the axis [px].
OUTLINE_BIAS_PX, END_BIAS_PX, END_ON_BIAS_PX = 0.2, 1.0, 4.0
GRASS_SHARE: Final = 0.12  # systematic error from grass in front of the log, as a share of the noise of depth
# Errors of the straight cylinder as a model of a log with taper, bow and bark: m, m, rad, rad, m, m, m.
MODEL_SIGMA: Final = np.array([0.004, 0.004, 0.004, 0.004, 0.008, 0.008, 0.003])


@dataclass(frozen=True, slots=True)
class CylinderFit:
    """A fitted cylinder in the optical frame, with its middle as the point.

    ``covariance`` (7, 7) is that of one frame's errors in the order of ``log_list.estimate``, but along the directions
    of ``across_view``, and without the common scale error of depth.  ``ends_seen`` says which ends have contour of
    their own.  ``explained`` is the share of the contour that the cylinder explains, ``rms_px`` the distance between
    the two.
    """

    body: Cylinder
    covariance: np.ndarray
    ends_seen: tuple[bool, bool]
    explained: float
    rms_px: float
    systematic: np.ndarray
    """Standard deviations (7,) of the errors that similar pictures have in common; ``covariance`` includes them."""


def fit_cylinder(
    mask: np.ndarray, depth_m: np.ndarray, pin: Intrinsics, first: Cylinder, border_px: Contour, sensor: StereoSensor
) -> CylinderFit | None:
    """Fit the best cylinder near ``first``; None when the mask has too little depth or contour, or no cylinder fits."""
    problem = _Problem.of(mask, depth_m, pin, first, border_px, sensor)
    if problem is None:
        return None
    first = problem.widened(first)
    body = _minimised(problem, first, 1.0)
    fit = problem.fit_of(body) if body is not None else None
    if fit is None or fit.explained < RETRY_EXPLAINED_SHARE:
        # From a poor initial cylinder, much of a true contour looks like outliers: begin with a wider loss.
        body = _minimised(problem, first, WIDE_SCALE_FACTOR)
        body = _minimised(problem, body, 1.0) if body is not None else None
        second = problem.fit_of(body) if body is not None else None
        if fit is None or (second is not None and second.explained > fit.explained):
            fit = second
    return fit


def _minimised(problem: _Problem, body: Cylinder, scale_factor: float) -> Cylinder | None:
    """Minimise by Levenberg-Marquardt from ``body``; None when numbers overflow."""
    damping = 1e-3
    for i in range(MAX_ITERATIONS):
        if i in (0, 2):
            metres_px = problem.gradient(body)
            raw = problem.residuals(CylinderBatch.around(body, _STEPS), metres_px)
        residuals, jacobian, weights, cost = problem.linearised(raw, scale_factor)
        wj = jacobian * weights[:, None]
        normal, gradient = jacobian.T @ wj, wj.T @ residuals
        if not (math.isfinite(cost) and np.isfinite(normal).all()):
            return None
        stiff = normal.diagonal() + 1e-6
        for _ in range(4):
            step = -np.linalg.solve(normal + damping * stiff * _EYE, gradient)
            step *= min(1.0, 1.0 / float((np.abs(step) / _MAX_STEP).max()))
            trial = CylinderBatch.around(body, step[None]).one(0)
            if trial.radius_m > MIN_RADIUS_M and trial.length_m > MIN_LENGTH_M and trial.center_m[2] > MIN_DEPTH_M:
                # Evaluate the derivatives as well: the step is mostly accepted, and the next iteration needs them.
                raw = problem.residuals(CylinderBatch.around(trial, _STEPS), metres_px)
                if problem.cost(raw[0], scale_factor) < cost:
                    break
            damping *= 10.0
        else:
            return body
        body, damping = trial, max(1e-6, damping * 0.1)
        if step @ normal @ step < CONVERGED_STEP2 * scale_factor * scale_factor:
            return body
    return body


def _innermost(mask: np.ndarray) -> np.ndarray:
    """Find the inner part of a mask (H, W), up to ``FATTENING_PX`` from its border, with at least 0.4 of its pixels."""
    sums = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), np.int32)
    np.cumsum(np.cumsum(mask, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
    min_pixel_count = 0.4 * int(sums[-1, -1])
    for reach in (FATTENING_PX, 5, 3, 2, 1):
        side = 2 * reach + 1
        if side > min(mask.shape):
            continue
        inside = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
        if np.count_nonzero(inside == side**2) >= min_pixel_count:
            inner = np.zeros(mask.shape, bool)
            inner[reach:-reach, reach:-reach] = inside == side**2
            return inner
    return mask


@dataclass(frozen=True, slots=True)
class _Problem:
    """Rays of contour and depth points, inverse depths with standard deviations, weights, and the initial cylinder."""

    rays: np.ndarray
    own: np.ndarray
    inverse: np.ndarray
    spread: np.ndarray
    weight: np.ndarray
    cauchy_scale: np.ndarray
    pixel: float
    noise: float
    prior: Cylinder
    foreground_share: float
    """Share of the information from depth that lies close to a nearer object, where stereo may be biased towards it."""

    @classmethod
    def of(
        cls,
        mask: np.ndarray,
        depth_m: np.ndarray,
        pin: Intrinsics,
        first: Cylinder,
        edge: Contour,
        sensor: StereoSensor,
    ) -> _Problem | None:
        known = mask & np.isfinite(depth_m)
        v, u = np.nonzero(known)
        if len(u) < MIN_PIXELS or np.count_nonzero(edge.own) < MIN_OWN_POINTS:
            return None
        area = len(u)
        long_px = max(math.hypot(float(np.ptp(edge.u_px)), float(np.ptp(edge.v_px))), 1.0)
        cells = (1.0 + long_px / DEPTH_CORRELATION_PX) * (1.0 + area / long_px / DEPTH_CORRELATION_PX)
        # Stereo matching fattens near edges: pixels far from any border are affected least.
        inner = _innermost(mask)[v, u]
        u, v = u[inner], v[inner]
        if not len(u):
            return None
        if len(u) > MAX_DEPTH_POINTS:
            pick = np.linspace(0, len(u) - 1, MAX_DEPTH_POINTS).astype(int)
            u, v = u[pick], v[pick]
        inverse, noise = 1.0 / depth_m[v, u].astype(float), sensor.sigma_d_px / sensor.fb_px_m
        du, dv = u[:, None] - edge.u_px[~edge.own], v[:, None] - edge.v_px[~edge.own]
        touched = np.min(du * du + dv * dv, axis=1, initial=np.inf) < FATTENING_PX**2
        spread = np.hypot(noise, touched * FOREGROUND_BIAS_SIGMA_M * inverse * inverse)
        information = spread**-2.0
        spacing = 2.0 * (long_px + area / long_px) / len(edge.u_px)
        n, m = len(edge.u_px), len(u)
        return cls(
            pixel_rays(pin, np.concatenate([edge.u_px, u]), np.concatenate([edge.v_px, v])),
            edge.own,
            inverse,
            spread,
            np.repeat([min(1.0, spacing / OUTLINE_CORRELATION_PX), min(1.0, cells / m), 1.0], [n, m, 4]),
            np.repeat([OUTLINE_CAUCHY_SCALE, DEPTH_CAUCHY_SCALE, 1e6], [n, m, 4]),
            1.0 / pin.fx_px,
            noise,
            first,
            float(information @ touched / information.sum()),
        )

    def widened(self, first: Cylinder) -> Cylinder:
        """Return ``first``, or where a side of it is hidden a log of mean radius with one side at the visible strip.

        The likeliest of the three is taken: the minimisation does not reach the wide log from the narrow strip.
        """
        radius_change_m = MEAN_RADIUS_M - first.radius_m
        if radius_change_m <= 0.0 or np.count_nonzero(self.own) > MIN_OWN_SHARE * len(self.own):
            return first
        steps = np.zeros((3, 8))
        steps[1:, 6], steps[1:, 0] = radius_change_m, (-radius_change_m, radius_change_m)
        bodies = CylinderBatch.around(first, steps)
        raw = self.residuals(bodies, self.gradient(first))
        return bodies.one(int(np.argmin([self.cost(r, WIDE_SCALE_FACTOR) for r in raw])))

    def gradient(self, body: Cylinder) -> np.ndarray:
        """Compute the change of ``outline_distance`` per pixel (N,) [m/px]."""
        batch, p, rays = CylinderBatch.of(body), self.pixel, self.rays[: len(self.own)]
        shifts = np.array([(p, 0.0, 0.0), (0.0, p, 0.0), (-p, 0.0, 0.0), (0.0, -p, 0.0)])
        g = outline_distance(batch, (rays + shifts[:, None]).reshape(-1, 3))[0].reshape(4, -1)
        return np.asarray(np.maximum(0.5 * np.hypot(g[0] - g[2], g[1] - g[3]), 1e-4))

    def residuals(self, bodies: CylinderBatch, metres_px: np.ndarray) -> np.ndarray:
        """Compute residuals (K, N) of K cylinders in standard deviations: outline, depth, two ends, radius, taper."""
        edge, deep_m = distance_and_depth(bodies, self.rays, len(self.own))
        edge /= metres_px
        edge = np.where(self.own, edge, np.maximum(edge, 0.0)) / OUTLINE_SIGMA_PX
        deep = (self.inverse - 1.0 / deep_m) / self.spread
        start, end, radius, growth = bodies.size
        usual = (radius - MEAN_RADIUS_M) / RADIUS_SIGMA_M
        ends = ((start - self.prior.start_m) / HIDDEN_END_SIGMA_M, (end - self.prior.end_m) / HIDDEN_END_SIGMA_M)
        return np.concatenate([edge, deep, *ends, usual, growth / TAPER_SIGMA], axis=1)

    def linearised(
        self, raw: np.ndarray, scale_factor: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Compute residuals (N,), derivatives (N, 8), weights (N,), cost from residuals (9, N) around a cylinder."""
        cauchy_scale = self._cauchy_scale(raw[0], scale_factor)
        far = (raw[0] / cauchy_scale) ** 2
        return raw[0], (raw[1:] - raw[0]).T / DERIVATIVE_STEP, self.weight / (1.0 + far), self._loss(cauchy_scale, far)

    def cost(self, residuals: np.ndarray, scale_factor: float = 1.0) -> float:
        """Compute the Cauchy loss; ``linearised`` returns its weights."""
        cauchy_scale = self._cauchy_scale(residuals, scale_factor)
        return self._loss(cauchy_scale, (residuals / cauchy_scale) ** 2)

    def _loss(self, cauchy_scale: np.ndarray, far: np.ndarray) -> float:
        return float((self.weight * cauchy_scale * cauchy_scale) @ np.log1p(far))

    def _cauchy_scale(self, residuals: np.ndarray, scale_factor: float) -> np.ndarray:
        """Compute the scale (N,) of the Cauchy loss: smaller for depth that is too near, because grass is."""
        is_outline = self.cauchy_scale == OUTLINE_CAUCHY_SCALE
        wide = np.where(is_outline, scale_factor * OUTLINE_CAUCHY_SCALE, self.cauchy_scale)
        near = (self.cauchy_scale == DEPTH_CAUCHY_SCALE) & (residuals > 0.0)
        return np.asarray(np.where(near, NEAR_CAUCHY_SCALE, wide))

    def fit_of(self, body: Cylinder) -> CylinderFit | None:
        """Compute the fit with its covariance; None when the data do not determine it."""
        ends = self._ends(body)
        arch_fit = self._arch_fit(body, all(ends))
        if arch_fit is None:
            return None
        body, edge, covariance = arch_fit
        own = edge[self.own] * OUTLINE_SIGMA_PX
        misfit = float(np.sqrt(np.mean(np.minimum(own * own, 25.0))))
        covariance *= max(1.0, (misfit / OUTLINE_SIGMA_PX) ** 2)
        systematic = self._systematic_sigmas(body)
        covariance[:7, :7] += np.diag(systematic**2)
        for row, end_seen in zip((START, END), ends, strict=True):
            # A few points of the sides say nothing of an end.
            covariance[row, row] += 0.0 if end_seen else HIDDEN_END_SIGMA_M**2
        move = 0.5 * (body.start_m + body.end_m)
        shift = np.eye(7, 8)
        shift[0, 2] = shift[1, 3] = shift[6, 7] = move
        return CylinderFit(
            body.centered(), shift @ covariance @ shift.T, ends, float(np.mean(np.abs(own) < 2.0)), misfit, systematic
        )

    def _arch_fit(self, body: Cylinder, whole: bool) -> tuple[Cylinder, np.ndarray, np.ndarray] | None:
        """Fit a bowed log: its straight cylinder, residuals of the contour and covariance (8, 8).

        A log that is not seen whole is kept straight.  None when the data do not determine the fit.
        """
        metres_px, bow = self.gradient(body), np.zeros(2)
        bow_sigma_m = BOW_SIGMA_SHARE * body.length_m if whole else STRAIGHT_SIGMA_M
        prior = np.diag(np.repeat([0.0, bow_sigma_m**-2.0], [8, 2]))
        try:
            for _ in range(ARCH_ITERATIONS):
                residuals, jacobian, weights = self._arch_system(body, bow, metres_px)
                normal = jacobian.T @ (jacobian * weights[:, None]) + prior
                covariance = np.linalg.inv(normal)
                step = -covariance @ (jacobian.T @ (weights * residuals) + prior[:, 8:] @ bow)
                bow = bow + step[8:]
                step = step[:8] * min(1.0, 1.0 / float((np.abs(step[:8]) / _MAX_STEP).max()))
                body = CylinderBatch.around(body, step[None]).one(0)
                if body.radius_m < MIN_RADIUS_M:
                    return None
        except np.linalg.LinAlgError:
            return None
        final_residuals = self.residuals(CylinderBatch.of(body), metres_px)[0] + jacobian[:, 8:] @ bow
        return body, final_residuals[: len(self.own)], covariance[:8, :8]

    def _arch_system(
        self, body: Cylinder, bow: np.ndarray, metres_px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute residuals (N,), derivatives (N, 10) and weights (N,) of a cylinder whose axis is an arch.

        ``bow`` (2,) [m] is the rise of the arch across the view and along it.  Locally, the arch is the straight
        cylinder shifted.
        """
        raw = self.residuals(CylinderBatch.around(body, _STEPS), metres_px)
        half = 0.5 * body.length_m
        at = (axial_positions(body, self.rays, len(self.own)) - body.start_m) / half - 1.0
        arch = np.concatenate([1.0 / 3.0 - at * at, np.zeros(4)])  # of mean 0, so that the mean position is kept
        jacobian = (raw[1:] - raw[0]).T / DERIVATIVE_STEP
        jacobian = np.hstack([jacobian, jacobian[:, :2] * arch[:, None]])
        raw = raw + jacobian[:, 8:] @ bow
        weights = self.linearised(raw)[2]
        weights[: len(self.own)][~self.own] = 0.0  # points that only have to be inside say nothing of the width
        return raw[0], jacobian, weights

    def _systematic_sigmas(self, body: Cylinder) -> np.ndarray:
        """Compute standard deviations (7,) of systematic errors.

        Causes: bark and bow, a share of a pixel of the outline, grass in front of the log, which makes depth nearer,
        and foreground fattening: of objects in front, and of the nearer parts of a log that is seen along its axis.
        """
        z = float(body.center_m[2])
        slant2 = min(0.99, float(body.axis @ body.center_m) ** 2 / float(body.center_m @ body.center_m))
        across = math.sqrt(1.0 - slant2)
        pixel, tilt = z * self.pixel, 2.0 / body.length_m
        deep = math.hypot(GRASS_SHARE * z * z * self.noise, FOREGROUND_BIAS_SIGMA_M * self.foreground_share)
        end = (END_BIAS_PX + END_ON_BIAS_PX * slant2) * pixel / across
        tilt_deep = tilt * math.hypot(deep, 0.5 * end * across)
        side = OUTLINE_BIAS_PX * pixel
        return np.asarray(np.hypot(MODEL_SIGMA, (side, deep, side * tilt, tilt_deep, end, end, side)))

    def _ends(self, body: Cylinder) -> tuple[bool, bool]:
        """Tell whether each end is visible: at least half of the contour points at it are the log's own."""
        bodies = CylinderBatch.around(body, _LONGER_STEPS)
        distance_m, start, end = outline_distance(bodies, self.rays[: len(self.own)])
        slack = 0.3 * self.pixel * float(body.center_m[2])
        ends_seen = []
        for moved in (start, end):
            at = distance_m - moved > slack  # contour points that a longer log would not have
            ends_seen.append(bool(np.count_nonzero(at & self.own) >= max(3, 0.5 * np.count_nonzero(at))))
        return ends_seen[0], ends_seen[1]
