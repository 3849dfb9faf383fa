"""Render and compare: the cylinder whose outline and depth are those of a mask and its stereo picture.

Robust least squares over seven numbers (across the view, along it, two tilts, both ends, radius) and the taper, with
analytic rendering in place of pixels: outline points of the mask must touch the body, depth inside must be that of its
visible surface.  Where something nearer cuts the mask, or the picture ends, the outline is not the log's: such points
must only lie inside the body, an end without outline of its own is not an end, and a log of which one side shows is as
wide as logs usually are, which the covariance says.  Stereo draws depth there to what is nearer, so it counts for less.
Neighbouring points err alike, so they count for less than their number too.
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
    outline,
    outline_and_depth,
    pixel_rays,
    places,
)
from autonomy.perception.log_list.estimate import END, START
from machine.geometry.optics import Intrinsics

DEPTH_POINTS: Final = 80
OUTLINE_SIGMA_PX: Final = 0.6  # of the mask's border, and of bark and bow against a straight cylinder
ALIKE_PX: Final = 17.7  # sqrt(pi) x 10 px: along a line, stereo errs alike over this
ALIKE_OUTLINE_PX: Final = 5.0
FATTENED_PX: Final = 8  # so far do edges grow
DRAWN_M: Final = 0.15  # by so much is depth wrong that was drawn to what lies before, standard deviation
USUAL_M, USUAL_SIGMA_M = 0.12, 0.05  # radius of a log of which one side is seen
HALF_SEEN: Final = 0.8  # share of a border that is a log's own below which one of its sides may be hidden
END_SIGMA_M: Final = 0.6  # of an end that is not seen
OUTLINE_BEND: Final = 3.0  # standard deviations beyond which a point begins to count for less
DEPTH_BEND, NEAR_BEND = 2.5, 1.5
WIDE: Final = 6.0
EXPLAINED: Final = 0.7  # share of the outline below which a fit is tried again
GROWTH: Final = 0.006  # of the radius along a log [m/m], standard deviation; which end is the butt is not known
BOW: Final = 0.018  # rise of a log's arch over its length, standard deviation in each direction
STRAIGHT_M: Final = 1e-4
LEAST_M: Final = 0.01  # radius
BOWED: Final = 2  # steps from the straight log to the arch
ITERATIONS: Final = 14
SETTLED: Final = 0.1  # squared length of a step, in standard deviations, after which two more are enough
STEP: Final = 1e-3  # of the numerical derivatives [m, rad]
_EYE: Final = np.eye(8)
_STEPS: Final = np.concatenate([np.zeros((1, 8)), STEP * _EYE])
_LONGER: Final = np.zeros((3, 8))
_LONGER[1, 4], _LONGER[2, 5] = -0.5, 0.5
_REACH: Final = np.array([0.4, 0.6, 0.5, 0.5, 0.6, 0.6, 0.08, 0.02])  # greatest change of one iteration
SHARE_PX, END_PX, GROWN_PX = 0.2, 1.0, 4.0  # of an outline, of an end, and of one seen along the axis
GRASS: Final = 0.12  # of the noise of depth
# What a straight cylinder cannot say of a log that tapers, bows and has bark: m, m, rad, rad, m, m, m.
FLOOR: Final = np.array([0.004, 0.004, 0.004, 0.004, 0.008, 0.008, 0.003])


@dataclass(frozen=True, slots=True)
class CylinderFit:
    """A cylinder in the optical frame, its middle as the point; ``covariance`` (7, 7) of one frame's errors, in the
    order of ``estimate`` but along ``across_view``'s directions, without the depth's common scale error;
    ``ends_seen``; the share of the outline that is explained; pixels between model and outline (root mean square)."""

    body: Cylinder
    covariance: np.ndarray
    ends_seen: tuple[bool, bool]
    explained: float
    rms_px: float
    systematic: np.ndarray
    """Standard deviations (7,), in ``covariance`` too, of what pictures like this one get wrong alike."""


def fit_cylinder(
    mask: np.ndarray, depth_m: np.ndarray, pin: Intrinsics, first: Cylinder, border_px: Contour, sensor: StereoSensor
) -> CylinderFit | None:
    """The best cylinder near ``first``; None when the mask has too little depth or outline, or no cylinder fits."""
    problem = _Problem.of(mask, depth_m, pin, first, border_px, sensor)
    if problem is None:
        return None
    first = problem.widened(first)
    body = _descended(problem, first, 1.0)
    fit = problem.judged(body) if body is not None else None
    if fit is None or fit.explained < EXPLAINED:
        # From a poor guess much of a true outline looks like outliers: forgive it at first.
        body = _descended(problem, first, WIDE)
        body = _descended(problem, body, 1.0) if body is not None else None
        second = problem.judged(body) if body is not None else None
        if fit is None or (second is not None and second.explained > fit.explained):
            fit = second
    return fit


def _descended(problem: _Problem, body: Cylinder, forgive: float) -> Cylinder | None:
    """Levenberg and Marquardt's way down from ``body``; None when numbers overflow."""
    damping = 1e-3
    for i in range(ITERATIONS):
        if i in (0, 2):
            metres_px = problem.gradient(body)
            raw = problem.residuals(CylinderBatch.around(body, _STEPS), metres_px)
        residuals, jacobian, weights, cost = problem.linearised(raw, forgive)
        wj = jacobian * weights[:, None]
        normal, gradient = jacobian.T @ wj, wj.T @ residuals
        if not (math.isfinite(cost) and np.isfinite(normal).all()):
            return None
        stiff = normal.diagonal() + 1e-6
        for _ in range(4):
            step = -np.linalg.solve(normal + damping * stiff * _EYE, gradient)
            step *= min(1.0, 1.0 / float((np.abs(step) / _REACH).max()))
            one = CylinderBatch.around(body, step[None]).one(0)
            if one.radius_m > LEAST_M and one.length_m > 0.05 and one.center_m[2] > 0.1:
                # With its neighbours: mostly it is taken, and these are wanted next.
                raw = problem.residuals(CylinderBatch.around(one, _STEPS), metres_px)
                if problem.cost(raw[0], forgive) < cost:
                    break
            damping *= 10.0
        else:
            return body
        body, damping = one, max(1e-6, damping * 0.1)
        if step @ normal @ step < SETTLED * forgive * forgive:
            return body
    return body


def _innermost(mask: np.ndarray) -> np.ndarray:
    """The half of a mask (H, W) or more, that is furthest from any border, at most ``FATTENED_PX``."""
    sums = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), np.int32)
    np.cumsum(np.cumsum(mask, axis=0, dtype=np.int32), axis=1, out=sums[1:, 1:])
    wanted = 0.4 * int(sums[-1, -1])
    for reach in (FATTENED_PX, 5, 3, 2, 1):
        side = 2 * reach + 1
        if side > min(mask.shape):
            continue
        inside = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
        if np.count_nonzero(inside == side**2) >= wanted:
            inner = np.zeros(mask.shape, bool)
            inner[reach:-reach, reach:-reach] = inside == side**2
            return inner
    return mask


@dataclass(frozen=True, slots=True)
class _Problem:
    """Rays of the outline, rays of depth with inverse depths and their deviations, what all weigh, and the guess."""

    rays: np.ndarray
    own: np.ndarray
    inverse: np.ndarray
    spread: np.ndarray
    weight: np.ndarray
    bend: np.ndarray
    pixel: float
    noise: float
    prior: Cylinder
    drawn: float
    """Share, of what depth tells, that is so near to something before the log that stereo may have drawn it there."""

    @classmethod
    def of(
        cls, mask: np.ndarray, depth_m: np.ndarray, pin: Intrinsics, first: Cylinder, edge: Contour, sensor: StereoSensor
    ) -> _Problem | None:
        known = mask & np.isfinite(depth_m)
        v, u = np.nonzero(known)
        if len(u) < MIN_PIXELS or np.count_nonzero(edge.own) < 8:
            return None
        area = len(u)
        long_px = max(math.hypot(float(np.ptp(edge.u_px)), float(np.ptp(edge.v_px))), 1.0)
        cells = (1.0 + long_px / ALIKE_PX) * (1.0 + area / long_px / ALIKE_PX)
        # Stereo lets near edges grow over what is behind them: what lies furthest from any border is least touched.
        inner = _innermost(mask)[v, u]
        u, v = u[inner], v[inner]
        if not len(u):
            return None
        if len(u) > DEPTH_POINTS:
            pick = np.linspace(0, len(u) - 1, DEPTH_POINTS).astype(int)
            u, v = u[pick], v[pick]
        inverse, noise = 1.0 / depth_m[v, u].astype(float), sensor.sigma_d_px / sensor.fb_px_m
        du, dv = u[:, None] - edge.u_px[~edge.own], v[:, None] - edge.v_px[~edge.own]
        touched = np.min(du * du + dv * dv, axis=1, initial=np.inf) < FATTENED_PX**2
        spread = np.hypot(noise, touched * DRAWN_M * inverse * inverse)
        worth = spread**-2.0
        spacing = 2.0 * (long_px + area / long_px) / len(edge.u_px)
        n, m = len(edge.u_px), len(u)
        return cls(
            pixel_rays(pin, np.concatenate([edge.u_px, u]), np.concatenate([edge.v_px, v])), edge.own, inverse, spread,
            np.repeat([min(1.0, spacing / ALIKE_OUTLINE_PX), min(1.0, cells / m), 1.0], [n, m, 4]),
            np.repeat([OUTLINE_BEND, DEPTH_BEND, 1e6], [n, m, 4]),
            1.0 / pin.fx_px, noise, first, float(worth @ touched / worth.sum()),
        )  # fmt: skip

    def widened(self, first: Cylinder) -> Cylinder:
        """``first``, or where one of its sides is hidden a log of usual width with its other side there, if that is
        likelier: from the narrow strip that is seen there is no way down to it.
        """
        more = USUAL_M - first.radius_m
        if more <= 0.0 or np.count_nonzero(self.own) > HALF_SEEN * len(self.own):
            return first
        steps = np.zeros((3, 8))
        steps[1:, 6], steps[1:, 0] = more, (-more, more)
        bodies = CylinderBatch.around(first, steps)
        raw = self.residuals(bodies, self.gradient(first))
        return bodies.one(int(np.argmin([self.cost(r, WIDE) for r in raw])))

    def gradient(self, body: Cylinder) -> np.ndarray:
        """Metres of ``outline`` per pixel (N,)."""
        one, p, rays = CylinderBatch.of(body), self.pixel, self.rays[: len(self.own)]
        shifts = np.array([(p, 0.0, 0.0), (0.0, p, 0.0), (-p, 0.0, 0.0), (0.0, -p, 0.0)])
        g = outline(one, (rays + shifts[:, None]).reshape(-1, 3))[0].reshape(4, -1)
        return np.maximum(0.5 * np.hypot(g[0] - g[2], g[1] - g[3]), 1e-4)

    def residuals(self, bodies: CylinderBatch, metres_px: np.ndarray) -> np.ndarray:
        """What is left (K, N) of the K bodies, in standard deviations: outline, depth, two ends, radius, growth."""
        edge, deep_m = outline_and_depth(bodies, self.rays, len(self.own))
        edge /= metres_px
        edge = np.where(self.own, edge, np.maximum(edge, 0.0)) / OUTLINE_SIGMA_PX
        deep = (self.inverse - 1.0 / deep_m) / self.spread
        start, end, radius, growth = bodies.size
        usual = (radius - USUAL_M) / USUAL_SIGMA_M
        ends = ((start - self.prior.start_m) / END_SIGMA_M, (end - self.prior.end_m) / END_SIGMA_M)
        return np.concatenate([edge, deep, *ends, usual, growth / GROWTH], axis=1)

    def linearised(self, raw: np.ndarray, forgive: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Residuals (N,), their derivatives (N, 8), weights (N,) and cost by the residuals (9, N) around a body."""
        bend = self._bend(raw[0], forgive)
        far = (raw[0] / bend) ** 2
        return raw[0], (raw[1:] - raw[0]).T / STEP, self.weight / (1.0 + far), self._loss(bend, far)

    def cost(self, residuals: np.ndarray, forgive: float = 1.0) -> float:
        """Cauchy's loss, whose weights ``linearised`` gives."""
        bend = self._bend(residuals, forgive)
        return self._loss(bend, (residuals / bend) ** 2)

    def _loss(self, bend: np.ndarray, far: np.ndarray) -> float:
        return float((self.weight * bend * bend) @ np.log1p(far))

    def _bend(self, residuals: np.ndarray, forgive: float) -> np.ndarray:
        """Where (N,) a residual begins to count as an outlier: sooner for depth that is too near, for grass is."""
        wide = np.where(self.bend == OUTLINE_BEND, forgive * OUTLINE_BEND, self.bend)
        return np.where((self.bend == DEPTH_BEND) & (residuals > 0.0), NEAR_BEND, wide)

    def judged(self, body: Cylinder) -> CylinderFit | None:
        """The fit with its covariance; None when the data do not determine it."""
        ends = self._ends(body)
        found = self._arched(body, all(ends))
        if found is None:
            return None
        body, edge, covariance = found
        own = edge[self.own] * OUTLINE_SIGMA_PX
        misfit = float(np.sqrt(np.mean(np.minimum(own * own, 25.0))))
        covariance *= max(1.0, (misfit / OUTLINE_SIGMA_PX) ** 2)
        systematic = self._lasting(body)
        covariance[:7, :7] += np.diag(systematic**2)
        for row, seen in zip((START, END), ends, strict=True):
            covariance[row, row] += 0.0 if seen else END_SIGMA_M**2  # whatever a few points of its sides pretend
        move = 0.5 * (body.start_m + body.end_m)
        shift = np.eye(7, 8)
        shift[0, 2] = shift[1, 3] = shift[6, 7] = move
        return CylinderFit(
            body.centered(), shift @ covariance @ shift.T, ends, float(np.mean(np.abs(own) < 2.0)), misfit, systematic
        )

    def _arched(self, body: Cylinder, whole: bool) -> tuple[Cylinder, np.ndarray, np.ndarray] | None:
        """The body as an arch, or straight where it is not seen whole, which says little of an arch: the straight one
        that it is bent from, residuals of the outline and covariance (8, 8); None when the data do not determine it."""
        metres_px, bow = self.gradient(body), np.zeros(2)
        told = np.diag(np.repeat([0.0, (BOW * body.length_m if whole else STRAIGHT_M) ** -2.0], [8, 2]))
        try:
            for _ in range(BOWED):
                residuals, jacobian, weights = self._bowed(body, bow, metres_px)
                normal = jacobian.T @ (jacobian * weights[:, None]) + told
                covariance = np.linalg.inv(normal)
                step = -covariance @ (jacobian.T @ (weights * residuals) + told[:, 8:] @ bow)
                bow = bow + step[8:]
                step = step[:8] * min(1.0, 1.0 / float((np.abs(step[:8]) / _REACH).max()))
                body = CylinderBatch.around(body, step[None]).one(0)
                if body.radius_m < LEAST_M:
                    return None
        except np.linalg.LinAlgError:
            return None
        left = self.residuals(CylinderBatch.of(body), metres_px)[0] + jacobian[:, 8:] @ bow
        return body, left[: len(self.own)], covariance[:8, :8]

    def _bowed(
        self, body: Cylinder, bow: np.ndarray, metres_px: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (N,), derivatives (N, 10) and weights (N,) of a body whose axis is an arch: ``bow`` (2,) [m] is its
        rise across the view and along it.  Where a ray passes, it is the straight body moved aside."""
        raw = self.residuals(CylinderBatch.around(body, _STEPS), metres_px)
        half = 0.5 * body.length_m
        at = (places(body, self.rays, len(self.own)) - body.start_m) / half - 1.0
        arch = np.concatenate([1.0 / 3.0 - at * at, np.zeros(4)])  # its mean is 0: the middle of all of it stays
        jacobian = (raw[1:] - raw[0]).T / STEP
        jacobian = np.hstack([jacobian, jacobian[:, :2] * arch[:, None]])
        raw = raw + jacobian[:, 8:] @ bow
        weights = self.linearised(raw)[2]
        weights[: len(self.own)][~self.own] = 0.0  # what only has to be inside tells of no width
        return raw[0], jacobian, weights

    def _lasting(self, body: Cylinder) -> np.ndarray:
        """Bark and bow, a share of a pixel of outline, grass before the log, which draws depth nearer; and, seen along
        its axis, the nearer parts of the log itself, which stereo lets grow over the further ones; so it does with what
        lies before it."""
        z = float(body.center_m[2])
        slant2 = min(0.99, float(body.axis @ body.center_m) ** 2 / float(body.center_m @ body.center_m))
        across = math.sqrt(1.0 - slant2)
        pixel, tilt = z * self.pixel, 2.0 / body.length_m
        deep = math.hypot(GRASS * z * z * self.noise, DRAWN_M * self.drawn)
        end = (END_PX + GROWN_PX * slant2) * pixel / across
        tilt_deep = tilt * math.hypot(deep, 0.5 * end * across)
        found = (SHARE_PX * pixel, deep, SHARE_PX * pixel * tilt, tilt_deep, end, end, SHARE_PX * pixel)
        return np.hypot(FLOOR, found)

    def _ends(self, body: Cylinder) -> tuple[bool, bool]:
        """Whether each end has outline of its own: most of what of the border lies at it."""
        three = CylinderBatch.around(body, _LONGER)
        here, start, end = outline(three, self.rays[: len(self.own)])
        slack = 0.3 * self.pixel * float(body.center_m[2])
        seen = []
        for moved in (start, end):
            at = here - moved > slack  # the border that a longer log would not have
            seen.append(bool(np.count_nonzero(at & self.own) >= max(3, 0.5 * np.count_nonzero(at))))
        return seen[0], seen[1]
