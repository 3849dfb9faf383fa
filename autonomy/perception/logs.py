"""The log list: what a detector says lies in the scene, and the datagrams in which it is asked and answers.

The question is ``{"op":"logs","q":"..."}`` with the joint positions [rad, m] in the order of ``Joint``, "nan" for what
is not measured: a detector whose camera rides on the crane needs them.  The answer is
``[{"position_m","axis","length_m","diameter_m","id","covariance","seen"}, ...]`` in the base frame, ``id`` being the
log's number (without it, its place in the list), ``covariance`` how well the rest is known (it may be missing) and
``seen`` false when the log is remembered from an earlier look, or ``{"error": SENTENCE}``.  An answer is taken or
refused whole: a number that is not finite, an axis without length, a log that is wider than long (paper A's only real
failures come from such diameters), a negative variance or a number given twice refuses it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import msgspec

from machine.joints import N_JOINTS

_ROWS: Final = 7
TRIANGLE: Final = _ROWS * (_ROWS + 1) // 2
_DIAGONAL: Final = tuple(TRIANGLE - k * (k + 1) // 2 for k in range(_ROWS, 0, -1))


@dataclass(frozen=True, slots=True)
class LogObservation:
    """One log in the base frame: its centre, the direction of its axis (a unit vector, either sense), its
    size.

    ``covariance`` is that of ``autonomy.perception.estimate``, its upper triangle row by row (``TRIANGLE`` numbers), or
    None when nobody says how well the log is known.  ``seen``: the newest look shows it; otherwise it is remembered
    from an earlier one, and one that hung in the grapple is there no longer.
    """

    id: int
    center_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float
    covariance: tuple[float, ...] | None = None
    seen: bool = True


class LogsRefused(ValueError):
    """A log list that was refused whole; the message says why."""


class _Log(msgspec.Struct):
    position_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float
    id: int | None = None
    covariance: tuple[float, ...] | None = None
    seen: bool = True


class _Trouble(msgspec.Struct, forbid_unknown_fields=True):
    error: str


class _Question(msgspec.Struct):
    op: str
    q: str = ""


_DECODER: Final = msgspec.json.Decoder(list[_Log] | _Trouble)
_QUESTIONS: Final = msgspec.json.Decoder(_Question)


def question(q: Sequence[float]) -> bytes:
    """What a detector is asked; ``q`` are the joints, empty when nothing is known of them."""
    return msgspec.json.encode(_Question("logs", " ".join(f"{value:.6g}" for value in q)))


def parse_question(data: bytes) -> tuple[float, ...]:
    """The joints (``N_JOINTS``) in a question, all NaN when it does not say.

    Raises:
        LogsRefused: it is no question for logs.
    """
    try:
        asked = _QUESTIONS.decode(data)
        q = tuple(float(word) for word in asked.q.split()) or (math.nan,) * N_JOINTS
    except (msgspec.DecodeError, ValueError) as error:
        raise LogsRefused(f"this is no question for logs: {error}") from None
    if asked.op != "logs" or len(q) != N_JOINTS:
        raise LogsRefused(f"this is no question for logs: op {asked.op!r} with {len(q)} joints of {N_JOINTS}")
    return q


def answer(logs: Iterable[LogObservation]) -> bytes:
    """A detector's answer."""
    told = [_Log(o.center_m, o.axis, o.length_m, o.diameter_m, o.id, o.covariance, o.seen) for o in logs]
    return msgspec.json.encode(told)


def answer_trouble(sentence: str) -> bytes:
    """A detector's answer when it cannot look."""
    return msgspec.json.encode(_Trouble(sentence))


def parse_logs(data: bytes) -> tuple[LogObservation, ...]:
    """The log list in a detector's answer, axes normalised.

    Raises:
        LogsRefused: the answer is no such list, or one of its logs cannot exist, or the detector says why it has none.
    """
    try:
        told = _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise LogsRefused(f"the detector's answer is not a log list: {error}") from None
    if isinstance(told, _Trouble):
        raise LogsRefused(told.error)
    logs = tuple(_checked(place if log.id is None else log.id, log) for place, log in enumerate(told))
    if len({log.id for log in logs}) < len(logs):
        raise LogsRefused("two logs have the same number")
    return logs


def _checked(number: int, log: _Log) -> LogObservation:
    norm = math.hypot(*log.axis)
    if not all(map(math.isfinite, (*log.position_m, norm, log.length_m, log.diameter_m))) or norm < 1e-6:
        raise LogsRefused(f"log {number} has a value that is not finite or an axis without a direction")
    if not 0.0 < log.diameter_m < log.length_m:
        raise LogsRefused(f"log {number} is {log.length_m:g} m long and {log.diameter_m:g} m wide, which is no log")
    c = log.covariance
    if c is not None and (len(c) != TRIANGLE or not all(map(math.isfinite, c)) or min(c[i] for i in _DIAGONAL) < 0.0):
        raise LogsRefused(f"log {number} has a covariance that is none: {TRIANGLE} finite numbers, no variance below 0")
    axis = (log.axis[0] / norm, log.axis[1] / norm, log.axis[2] / norm)
    return LogObservation(number, log.position_m, axis, log.length_m, log.diameter_m, c, log.seen)
