"""What perception reports: log observations, their estimates with covariance, their datagrams."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import msgspec
import numpy as np

from autonomy.perception.standpoint import NUMBERS, Standpoint, from_numbers
from machine.joints import N_JOINTS
from runtime.errors import InputRefused

# -- One log as the rest of the machine receives it from perception.

_ROWS: Final = 7
TRIANGLE: Final = _ROWS * (_ROWS + 1) // 2
"""Numbers in the upper triangle of an observation's covariance."""


@dataclass(frozen=True, slots=True)
class LogObservation:
    """One log in the crane's base frame: centre [m], unit axis in either sense, length and diameter [m].

    ``covariance`` is the upper triangle, row by row (``TRIANGLE`` numbers), of the covariance of a ``LogEstimate``;
    None when it is unknown.  ``seen`` is True when the newest
    picture shows the log and False when the log is remembered from an earlier picture.  A remembered log that hung in
    the grapple is no longer where it was.
    """

    id: int
    center_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float
    covariance: tuple[float, ...] | None = None
    seen: bool = True


# -- The estimate of one log: seven numbers and their covariance.

ACROSS_1, ACROSS_2, TILT_1, TILT_2, START, END, RADIUS = range(7)
SIZE: Final = 7
HIDDEN_END_SIGMA_M: Final = 0.6
"""1-sigma of an end that no picture shows; an end with as great a one counts as not seen."""


@dataclass(frozen=True, slots=True)
class LogEstimate:
    """One log: centre (3,) [m] and unit axis (3,) in the crane's base frame, length and diameter [m].

    ``covariance`` (7, 7) is that of errors in the order ACROSS_1, ACROSS_2 [m] (of the axis at the centre, along the
    two directions of ``frame``), TILT_1, TILT_2 [rad] (of the axis towards these), START, END [m] (of the ends at
    -length/2 and +length/2, along the axis), RADIUS [m].  ``ends_seen`` says which ends are visible, not cut off by the
    edge of the picture or by something in front; the length is a lower bound unless both are.  ``score`` is in 0..1.
    """

    center_m: np.ndarray
    axis: np.ndarray
    length_m: float
    diameter_m: float
    covariance: np.ndarray
    ends_seen: tuple[bool, bool] = (True, True)
    score: float = 1.0

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the two unit vectors (3,) across the axis to which the covariance refers: level, and up."""
        return across(self.axis)

    def position_sigma_m(self) -> np.ndarray:
        """Compute standard deviations (3,) [m] of the centre: along ``frame``'s two directions and along the axis."""
        c = self.covariance
        along = 0.25 * (c[START, START] + c[END, END] + 2.0 * c[START, END])
        return np.sqrt(np.maximum([c[ACROSS_1, ACROSS_1], c[ACROSS_2, ACROSS_2], along], 0.0))

    def observation(self, number: int, seen: bool = True) -> LogObservation:
        """Return the observation with this number; ``seen``: the newest picture shows the log."""
        x, y, z = (float(v) for v in self.center_m)
        ax, ay, az = (float(v) for v in self.axis)
        # Four digits suffice, and a reply about a hundred logs must fit into one datagram.
        known = tuple(float(f"{v:.4g}") for v in self.covariance[np.triu_indices(SIZE)])
        length_m, diameter_m = float(self.length_m), float(self.diameter_m)
        return LogObservation(number, (x, y, z), (ax, ay, az), length_m, diameter_m, known, seen)


def unpack_covariance(triangle: tuple[float, ...]) -> np.ndarray:
    """Unpack the covariance (7, 7) of a ``LogObservation``."""
    upper = np.zeros((SIZE, SIZE))
    upper[np.triu_indices(SIZE)] = triangle
    return np.asarray(upper + np.triu(upper, 1).T)


def across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute two unit vectors across a unit axis (3,): first level (to the left of the axis), second upward."""
    up = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.95 else np.array([1.0, 0.0, 0.0])
    level = np.cross(up, axis)
    level /= np.linalg.norm(level)
    return level, np.cross(axis, level)


# -- The log list's datagrams: a request for logs and the reply of a detector.
#
# The request is ``{"op":"logs","q":"..."}``.  ``q`` holds the joint positions [rad, m] in the order of ``Joint``,
# "nan" where a joint is not measured: a detector whose camera rides on the crane needs them.  For a camera of a
# machine that drives, ``"at_ns"`` and ``"standpoint"`` say where the machine is in the plane
# (`autonomy.perception.standpoint`), and ``"load":true`` that its crane holds a load in front of the camera, which
# lies nowhere.  The reply is ``[{"position_m","axis","length_m","diameter_m","id","covariance","seen"}, ...]`` in
# the crane's base frame, ``{"plane": [...]}`` in that plane, or ``{"error": SENTENCE}``.  ``id`` is the log's
# number (default: its index in the list), ``covariance`` may be missing, and ``seen`` is false when the log is
# remembered from an earlier picture.
#
# A list is accepted or refused as a whole.  It is refused for a number that is not finite, an axis without length,
# a log that is wider than long (the cause of paper A's only real failures), a negative variance, or a number used
# twice.

_DIAGONAL: Final = tuple(TRIANGLE - k * (k + 1) // 2 for k in range(_ROWS, 0, -1))
_MIN_AXIS_NORM: Final = 1e-6


class _Log(msgspec.Struct):
    position_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float
    id: int | None = None
    covariance: tuple[float, ...] | None = None
    seen: bool = True


class _Answer(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """One of the two."""

    error: str | None = None
    plane: list[_Log] | None = None


class _Request(msgspec.Struct, omit_defaults=True):
    op: str
    q: str = ""
    at_ns: str = ""
    standpoint: str = ""
    load: bool = False


@dataclass(frozen=True, slots=True)
class LogRequest:
    """A request: joints [rad, m] in ``Joint`` order, NaN where unknown, and where a machine stands that drives."""

    q: tuple[float, ...]
    standpoint: Standpoint | None = None


_REPLIES: Final = msgspec.json.Decoder(list[_Log] | _Answer)
_REQUESTS: Final = msgspec.json.Decoder(_Request)


def encode_request(q: Sequence[float], standpoint: Standpoint | None = None) -> bytes:
    """Encode a request for logs; ``q`` are the joint positions, empty when none are known."""
    joints = " ".join(f"{value:.6g}" for value in q)
    if standpoint is None:
        return msgspec.json.encode(_Request("logs", joints))
    numbers = " ".join(f"{value:.9g}" for value in standpoint.numbers())
    return msgspec.json.encode(_Request("logs", joints, str(standpoint.stamp_ns), numbers, standpoint.load))


def decode_request(data: bytes) -> LogRequest:
    """Decode the request of a datagram; all joints are NaN when it holds none.

    Raises:
        InputRefused: the datagram is not a request for logs.
    """
    try:
        request = _REQUESTS.decode(data)
        q = tuple(float(word) for word in request.q.split()) or (math.nan,) * N_JOINTS
        numbers = tuple(float(word) for word in request.standpoint.split())
        at_ns = int(request.at_ns or "0")
    except (msgspec.DecodeError, ValueError) as error:
        raise InputRefused("log-list.not-a-request", f"the datagram is not a request for logs: {error}") from None
    if request.op != "logs" or len(q) != N_JOINTS:
        raise InputRefused(
            "log-list.not-a-request",
            f"the datagram is not a request for logs: op {request.op!r} with {len(q)} joints instead of {N_JOINTS}",
        )
    if not numbers:
        return LogRequest(q)
    if len(numbers) != NUMBERS or not all(map(math.isfinite, numbers)):
        raise InputRefused(
            "log-list.bad-standpoint",
            f"the request's standpoint is not {NUMBERS} finite numbers; its planner is of another release",
        )
    return LogRequest(q, replace(from_numbers(at_ns, numbers), load=request.load))


def encode_logs(logs: Iterable[LogObservation], in_plane: bool = False) -> bytes:
    """Encode a reply with a log list, in the crane's base frame or in the plane."""
    rows = [_Log(o.center_m, o.axis, o.length_m, o.diameter_m, o.id, o.covariance, o.seen) for o in logs]
    return msgspec.json.encode(_Answer(plane=rows) if in_plane else rows)


def encode_error(sentence: str) -> bytes:
    """Encode a reply without a log list: ``sentence`` says why there is none."""
    return msgspec.json.encode(_Answer(sentence))


def decode_logs(data: bytes, in_plane: bool = False) -> tuple[LogObservation, ...]:
    """Decode the log list of a reply, axes normalised; in the crane's base frame or ``in_plane``.

    Raises:
        InputRefused: the reply is not a log list, is in the other frame, a log in it is impossible, or it is an error.
    """
    try:
        reply = _REPLIES.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputRefused("log-list.not-a-list", f"the detector's reply is not a log list: {error}") from None
    rows = reply
    if isinstance(reply, _Answer):
        if reply.error is not None or reply.plane is None:
            raise InputRefused("log-list.detector-error", reply.error or "the detector's reply is empty")
        rows = reply.plane
    if isinstance(reply, _Answer) != in_plane:
        expected_frame, camera = (
            ("plane", "looks ahead of") if in_plane else ("crane's base frame", "stands still with")
        )
        raise InputRefused(
            "log-list.other-frame",
            f"the detector's list is not in the {expected_frame}; start a detector whose camera {camera} the machine",
        )
    assert isinstance(rows, list)
    logs = tuple(_checked(index if log.id is None else log.id, log) for index, log in enumerate(rows))
    if len({log.id for log in logs}) < len(logs):
        raise InputRefused("log-list.duplicate-id", "two logs of the detector's reply have the same number")
    return logs


def _checked(number: int, log: _Log) -> LogObservation:
    norm = math.hypot(*log.axis)
    if not all(map(math.isfinite, (*log.position_m, norm, log.length_m, log.diameter_m))) or norm < _MIN_AXIS_NORM:
        raise InputRefused("log-list.bad-value", f"log {number} has a value that is not finite or an axis of length 0")
    if not 0.0 < log.diameter_m < log.length_m:
        raise InputRefused(
            "log-list.bad-size", f"log {number} is {log.length_m:g} m long and {log.diameter_m:g} m wide: not a log"
        )
    c = log.covariance
    if c is not None and (len(c) != TRIANGLE or not all(map(math.isfinite, c)) or min(c[i] for i in _DIAGONAL) < 0.0):
        raise InputRefused(
            "log-list.bad-covariance",
            f"log {number} has an invalid covariance; it must be {TRIANGLE} finite numbers without a negative variance",
        )
    axis = (log.axis[0] / norm, log.axis[1] / norm, log.axis[2] / norm)
    return LogObservation(number, log.position_m, axis, log.length_m, log.diameter_m, c, log.seen)
