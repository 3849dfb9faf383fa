"""Crane kinematics to the hanger pin: forward, Jacobian and closed-form inverse.

Input is a joint vector ``q`` indexed by ``Joint`` (slew, lift, tilt in rad, extension in m; a fifth element,
the rotator, is ignored) and the profile's ``Kinematics``.  Output is in the base frame: origin above the
ground, z up, x = r cos(theta), y = r sin(theta) with theta = slew + theta1 offset, so slew 0 reaches +y on
``palms_471`` and +x on ``aoro_fc8``; boom and stick angles are positive upward, the stick angle is relative to the
boom.  The chain is the standard Denavit-Hartenberg chain (RRRP) with twists +pi/2, 0, +pi/2, 0.  These are encoder
kinematics: they do not include structural sag (`machine.geometry.sag`).

The crane works in one vertical plane through the slew axis, so all computation is in (r, z) of that plane.  Plain
floats only: this runs in the control tick and in planning.  Failure: ``Unreachable`` with the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import atan2, cos, degrees, hypot, pi, remainder, sin, sqrt
from typing import Any, Final, NamedTuple

from machine.joints import Joint
from machine.profile import Kinematics, Profile, joint, joint_limits
from runtime.errors import TimberhandError

Point = tuple[float, float, float]
Limits = Sequence[tuple[float, float]]

STOP_MARGIN_SHARE: Final = 0.02
"""Share of a joint's range that ``solve`` keeps free at either stop if possible."""
MIN_BEND_RAD: Final = 0.10
"""Smallest bend of the elbow that ``solve`` keeps if possible: the straight arm is singular."""
_LIMIT_SLACK: Final = 1e-9
_CLOSE_SLACK_M: Final = 1e-12
_BOOM_LINKS: Final = (Joint.LIFT, Joint.TILT, Joint.EXT)
_GOLDEN: Final = (sqrt(5.0) - 1.0) / 2.0


class Unreachable(TimberhandError, ValueError):
    """No joint position inside the limits reaches the point; the sentence says which limit and by how much."""

    def __init__(self, sentence: str, code: str = "reach.unreachable") -> None:
        super().__init__(code, sentence)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.code)


Obstacle = tuple[str, str]
"""Code and sentence of what keeps the pin from a point."""


class ChainPoints(NamedTuple):
    """Points for drawing, in the base frame [m]; the grapple hangs straight down from the hanger pin."""

    base: Point
    boom_pin: Point
    stick_pin: Point
    telescope_front: Point
    hanger_pin: Point
    rotator: Point
    grapple: Point


def _stick_vector(kin: Kinematics, phi: float, reach_m: float) -> tuple[float, float]:
    """Compute (r, z) from stick pin to a point ``reach_m`` along the telescope axis; ``phi``: angle of DH axis x3."""
    c, s = cos(phi), sin(phi)
    return kin.a3_m * c + reach_m * s, kin.a3_m * s - reach_m * c


def _boom_vector(kin: Kinematics, lift: float) -> tuple[float, float]:
    """Compute the vector from boom pin to stick pin, (r, z)."""
    phi = lift + kin.theta2_offset_rad
    return kin.a2_m * cos(phi), kin.a2_m * sin(phi)


def _phi3(kin: Kinematics, q: Sequence[float]) -> float:
    return q[Joint.LIFT] + q[Joint.TILT] + kin.theta2_offset_rad + kin.theta3_offset_rad


def _turn(kin: Kinematics, slew: float, r: float, z: float) -> Point:
    theta = slew + kin.theta1_offset_rad
    return r * cos(theta), r * sin(theta), z


def pin_position(kin: Kinematics, q: Sequence[float]) -> Point:
    """Compute the hanger pin (x, y, z) in m for ``q`` (at least four elements)."""
    boom_r, boom_z = _boom_vector(kin, q[Joint.LIFT])
    stick_r, stick_z = _stick_vector(kin, _phi3(kin, q), kin.d4_m + q[Joint.EXT])
    return _turn(kin, q[Joint.SLEW], kin.a1_m + boom_r + stick_r, kin.d1_m + boom_z + stick_z)


def chain_points(kin: Kinematics, q: Sequence[float]) -> ChainPoints:
    """List the points of the crane for drawing.

    ``telescope_front`` is where the pin is at extension 0, so the moving part shows its full extension.
    """
    slew, phi = q[Joint.SLEW], _phi3(kin, q)
    boom_r, boom_z = _boom_vector(kin, q[Joint.LIFT])
    r, z = kin.a1_m + boom_r, kin.d1_m + boom_z
    front = _stick_vector(kin, phi, kin.d4_m)
    pin = pin_position(kin, q)
    rotator_z = pin[2] - kin.hanger_to_fork_m - kin.fork_to_rotator_m
    return ChainPoints(
        base=(0.0, 0.0, 0.0),
        boom_pin=_turn(kin, slew, kin.a1_m, kin.d1_m),
        stick_pin=_turn(kin, slew, r, z),
        telescope_front=_turn(kin, slew, r + front[0], z + front[1]),
        hanger_pin=pin,
        rotator=(pin[0], pin[1], rotator_z),
        grapple=(pin[0], pin[1], rotator_z - kin.rotator_to_tong_pivot_m),
    )


def jacobian(kin: Kinematics, q: Sequence[float]) -> tuple[tuple[float, float, float, float], ...]:
    """Compute the derivative of the pin with respect to (slew, lift, tilt, ext): three rows x, y, z [m/rad, m/m]."""
    theta, phi = q[Joint.SLEW] + kin.theta1_offset_rad, _phi3(kin, q)
    ct, st = cos(theta), sin(theta)
    boom_r, boom_z = _boom_vector(kin, q[Joint.LIFT])
    stick_r, stick_z = _stick_vector(kin, phi, kin.d4_m + q[Joint.EXT])
    r = kin.a1_m + boom_r + stick_r
    lift_r, lift_z = -(boom_z + stick_z), boom_r + stick_r
    return (
        (-r * st, lift_r * ct, -stick_z * ct, sin(phi) * ct),
        (r * ct, lift_r * st, -stick_z * st, sin(phi) * st),
        (0.0, lift_z, stick_r, -cos(phi)),
    )


def max_reach_m(profile: Profile) -> float:
    """Compute the greatest distance of the pin from the slew axis, with the arm straight and level [m]."""
    kin = profile.kinematics
    return kin.a1_m + kin.a2_m + hypot(kin.a3_m, kin.d4_m + joint_limits(profile)[Joint.EXT][1])


class _Target(NamedTuple):
    """The point seen from the boom pin: slew angle, distance and elevation in the crane's plane."""

    slew: float
    distance_m: float
    elevation: float


def _target(kin: Kinematics, x: float, y: float, z: float) -> _Target:
    r, dz = hypot(x, y) - kin.a1_m, z - kin.d1_m
    slew = remainder(atan2(y, x) - kin.theta1_offset_rad, 2.0 * pi)
    return _Target(slew, hypot(r, dz), atan2(dz, r))


def _closes(kin: Kinematics, target: _Target, ext_m: float) -> bool:
    """Tell whether boom and stick span the distance with this extension."""
    stick = hypot(kin.a3_m, kin.d4_m + ext_m)
    d = target.distance_m
    return d > 0.0 and abs(kin.a2_m - stick) - _CLOSE_SLACK_M <= d <= kin.a2_m + stick + _CLOSE_SLACK_M


def _boom_and_stick(kin: Kinematics, target: _Target, ext_m: float) -> tuple[float, float]:
    """Compute lift and tilt (elbow up) for an extension whose triangle closes; joint limits are not checked."""
    d, boom, length = target.distance_m, kin.a2_m, kin.d4_m + ext_m
    stick = hypot(kin.a3_m, length)
    # Both angles from one area (Heron), so that they agree to rounding even where the arm is straight.
    heron = (boom + stick + d) * (boom + stick - d) * (d + boom - stick) * (d - boom + stick)
    area4 = sqrt(max(0.0, heron))
    at_pin = atan2(area4, boom * boom + d * d - stick * stick)
    at_elbow = atan2(area4, d * d - boom * boom - stick * stick)
    lift = target.elevation + at_pin - kin.theta2_offset_rad
    # The line stick pin - hanger pin lies atan2(-length, a3) from DH axis x3.
    tilt = -at_elbow + atan2(length, kin.a3_m) - kin.theta3_offset_rad
    return lift, tilt


def _slew_obstacle(slew: float, limits: Limits) -> Obstacle | None:
    low, high = limits[Joint.SLEW]
    if low - _LIMIT_SLACK <= slew <= high + _LIMIT_SLACK:
        return None
    text = f"slew {degrees(slew):.1f} deg is outside its limits {degrees(low):.1f}..{degrees(high):.1f} deg"
    return "reach.slew", text


def _boom_obstacle(lift: float, tilt: float, limits: Limits) -> Obstacle | None:
    low, high = limits[Joint.LIFT]
    if lift < low - _LIMIT_SLACK:
        return "reach.boom-lower-stop", f"the boom would be {degrees(low - lift):.1f} deg below its lower stop"
    if lift > high + _LIMIT_SLACK:
        return "reach.boom-upper-stop", f"the boom would be {degrees(lift - high):.1f} deg above its upper stop"
    low, high = limits[Joint.TILT]
    if tilt < low - _LIMIT_SLACK:
        return "reach.stick-folded-stop", f"the stick would be {degrees(low - tilt):.1f} deg below its folded stop"
    if tilt > high + _LIMIT_SLACK:
        return "reach.stick-straight-stop", f"the stick would be {degrees(tilt - high):.1f} deg above its straight stop"
    return None


def _distance_obstacle(kin: Kinematics, target: _Target, shortest: float, longest: float) -> Obstacle:
    """Tell why no extension in between closes the triangle; distances along the line from boom pin to point."""
    far = kin.a2_m + hypot(kin.a3_m, kin.d4_m + longest)
    if target.distance_m > far:
        return "reach.too-far", f"too far by {target.distance_m - far:.2f} m"
    stick_short, stick_long = (hypot(kin.a3_m, kin.d4_m + e) for e in (shortest, longest))
    near = max(0.0, stick_short - kin.a2_m, kin.a2_m - stick_long)
    return "reach.too-close", f"too close to the boom pin by {near - target.distance_m:.2f} m"


def _unreachable(x: float, y: float, z: float, obstacle: Obstacle) -> Unreachable:
    code, text = obstacle
    return Unreachable(f"point ({x:.2f}, {y:.2f}, {z:.2f}) m is out of reach: {text}", code)


def inverse(kin: Kinematics, limits: Limits, x: float, y: float, z: float, ext_m: float) -> tuple[float, float, float]:
    """Compute slew, lift and tilt in rad, elbow up, that bring the pin to a point with the given extension.

    ``limits`` is indexed by ``Joint`` (``machine.profile.joint_limits``).  The arm points toward the point; poses
    folded back behind the mast are not produced.

    Raises:
        Unreachable: no such joint position is inside the limits.
    """
    low, high = limits[Joint.EXT]
    if not low - _LIMIT_SLACK <= ext_m <= high + _LIMIT_SLACK:
        text = f"extension {ext_m:.2f} m is outside its limits {low:.2f}..{high:.2f} m"
        raise _unreachable(x, y, z, ("reach.extension", text))
    target = _target(kin, x, y, z)
    obstacle = _slew_obstacle(target.slew, limits)
    if not obstacle and not _closes(kin, target, ext_m):
        obstacle = _distance_obstacle(kin, target, ext_m, ext_m)
    if not obstacle:
        angles = _boom_and_stick(kin, target, ext_m)
        obstacle = _boom_obstacle(*angles, limits)
    if obstacle:
        raise _unreachable(x, y, z, obstacle)
    return target.slew, *angles


def _breakpoints(kin: Kinematics, limits: Limits, target: _Target) -> list[float]:
    """List every extension inside the telescope's range at which a limit can begin or cease to hold, sorted.

    Between two neighbours nothing changes, so one test in the middle decides the whole interval.
    """
    d, boom, a3 = target.distance_m, kin.a2_m, kin.a3_m
    lengths = [s * s - a3 * a3 for s in (boom - d, boom + d)]
    for lift in limits[Joint.LIFT]:  # boom on its stop: the stick spans what is left
        r, z = _boom_vector(kin, lift)
        gap_r, gap_z = d * cos(target.elevation) - r, d * sin(target.elevation) - z
        lengths.append(gap_r * gap_r + gap_z * gap_z - a3 * a3)
    out = [sqrt(square) - kin.d4_m for square in lengths if square >= 0.0]
    for tilt in limits[Joint.TILT]:  # stick on its stop: d^2 is quadratic in the length
        phi = tilt + kin.theta3_offset_rad
        half = boom * sin(phi)
        square = half * half - (boom * boom + a3 * a3 + 2.0 * boom * a3 * cos(phi) - d * d)
        if square >= 0.0:
            out += [-half - sqrt(square) - kin.d4_m, -half + sqrt(square) - kin.d4_m]
    low, high = limits[Joint.EXT]
    return [low, *sorted(e for e in out if low < e < high), high]


def _fits(kin: Kinematics, limits: Limits, target: _Target, ext_m: float) -> bool:
    return _closes(kin, target, ext_m) and not _boom_obstacle(*_boom_and_stick(kin, target, ext_m), limits)


def _intervals(kin: Kinematics, limits: Limits, target: _Target) -> list[tuple[float, float]]:
    points = _breakpoints(kin, limits, target)
    intervals: list[tuple[float, float]] = []
    for low, high in pairwise(points):
        if _fits(kin, limits, target, 0.5 * (low + high)):
            if intervals and intervals[-1][1] == low:
                low = intervals.pop()[0]
            intervals.append((low, high))
    # A point on the edge of the work space is reached by one extension only.
    return intervals or [(e, e) for e in points if _fits(kin, limits, target, e)]


def reachable_extensions(profile: Profile, x: float, y: float, z: float) -> tuple[tuple[float, float], ...]:
    """Find the intervals of the extension [m] with which the point is reached inside all limits; may be empty."""
    limits = joint_limits(profile)
    target = _target(profile.kinematics, x, y, z)
    if _slew_obstacle(target.slew, limits):
        return ()
    return tuple(_intervals(profile.kinematics, limits, target))


def _comfortable(kin: Kinematics, limits: Limits) -> list[tuple[float, float]]:
    """Return the limits less ``STOP_MARGIN_SHARE``, and the stick at least ``MIN_BEND_RAD`` off the straight arm."""
    inner = [(low + STOP_MARGIN_SHARE * (high - low), high - STOP_MARGIN_SHARE * (high - low)) for low, high in limits]
    straight = atan2(kin.d4_m + limits[Joint.EXT][0], kin.a3_m) - kin.theta3_offset_rad
    folded, stretched = inner[Joint.TILT]
    inner[Joint.TILT] = (folded, max(folded, min(stretched, straight - MIN_BEND_RAD)))
    return inner


def _least(cost: Callable[[float], float], low: float, high: float, n: int = 24) -> tuple[float, float]:
    """Find the (cost, argument) of the minimum on an interval: golden section around each low point of a grid."""
    step = (high - low) / n
    costs = [cost(low + i * step) for i in range(n + 1)]
    minima = []
    for i, grid_cost in enumerate(costs):
        if grid_cost > min(costs[max(0, i - 1) : i + 2]):
            continue
        a, b = max(low, low + (i - 1) * step), min(high, low + (i + 1) * step)
        while b - a > 1e-8:
            left, right = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
            if cost(left) <= cost(right):
                b = right
            else:
                a = left
        middle = 0.5 * (a + b)
        minima += [(grid_cost, low + i * step), (cost(middle), middle)]
    return min(minima)


def solve(
    profile: Profile, x: float, y: float, z: float, preference: float | Sequence[float] | None = None
) -> tuple[float, float, float, float]:
    """Find slew, lift, tilt [rad] and extension [m] for the pin at a point; ``preference`` resolves the redundancy.

    A number is a preferred extension (the nearest feasible one is used); a joint vector is the present pose (shortest
    travel time at the profile's speed limits); None keeps the joints farthest from their stops.  Poses near a stop or
    near the straight arm are used only if there is no other.

    Raises:
        Unreachable: no joint position inside the limits reaches the point.
    """
    kin, limits = profile.kinematics, joint_limits(profile)
    target = _target(kin, x, y, z)
    obstacle = _slew_obstacle(target.slew, limits)
    if obstacle:
        raise _unreachable(x, y, z, obstacle)
    intervals = _intervals(kin, _comfortable(kin, limits), target) or _intervals(kin, limits, target)
    if not intervals:
        raise _unreachable(x, y, z, _nearest_obstacle(kin, limits, target))

    def pose(ext: float) -> tuple[float, float, float]:
        return *_boom_and_stick(kin, target, ext), ext

    def crowding(ext: float) -> float:
        spans = ((v, *limits[j]) for v, j in zip(pose(ext), _BOOM_LINKS, strict=True))
        return -min(min(v - low, high - v) / (high - low) for v, low, high in spans)

    if preference is None:
        ext = min(_least(crowding, low, high) for low, high in intervals)[1]
    elif isinstance(preference, (int, float)):
        wish = float(preference)
        ext = min((max(low, min(high, wish)) for low, high in intervals), key=lambda e: abs(e - wish))
    else:
        present = [(preference[j], joint(profile, j).speed_limit) for j in _BOOM_LINKS]

        def travel_s(ext: float) -> float:
            return max(abs(v - at) / speed for v, (at, speed) in zip(pose(ext), present, strict=True))

        ext = min(_least(travel_s, low, high) for low, high in intervals)[1]
    return target.slew, *pose(ext)


def _nearest_obstacle(kin: Kinematics, limits: Limits, target: _Target) -> Obstacle:
    """Find the obstacle at the extension that violates the limits least."""
    low, high = limits[Joint.EXT]
    reasons: list[tuple[float, Obstacle]] = []
    for i in range(21):
        ext = low + (high - low) * i / 20
        if not _closes(kin, target, ext):
            continue
        angles = _boom_and_stick(kin, target, ext)
        spans = zip(angles, (limits[Joint.LIFT], limits[Joint.TILT]), strict=True)
        over = sum(max(lower - v, v - upper, 0.0) for v, (lower, upper) in spans)
        reasons.append((over, _boom_obstacle(*angles, limits) or ("reach.rounding", "by rounding only")))
    return min(reasons)[1] if reasons else _distance_obstacle(kin, target, low, high)
