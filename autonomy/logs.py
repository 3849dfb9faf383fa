"""The log list: what a detector says lies in the scene, and the datagrams in which it is asked and answers.

The question is ``{"op":"logs"}``; the answer is ``[{"position_m","axis","length_m","diameter_m"}, ...]`` in the
base frame, the place in the list being the log's number.  An answer is taken or refused whole: a number that is
not finite, an axis without length or a log that is wider than long (paper A's only real failures come from
such diameters) refuses it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import msgspec

QUESTION: Final = b'{"op":"logs"}'


@dataclass(frozen=True, slots=True)
class LogObservation:
    """One log in the base frame: its centre, the direction of its axis (a unit vector, either sense), its
    size.
    """

    id: int
    center_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float


class LogsRefused(ValueError):
    """A log list that was refused whole; the message says why."""


class _Log(msgspec.Struct):
    position_m: tuple[float, float, float]
    axis: tuple[float, float, float]
    length_m: float
    diameter_m: float


_DECODER: Final = msgspec.json.Decoder(list[_Log])


def parse_logs(data: bytes) -> tuple[LogObservation, ...]:
    """The log list in a detector's answer, axes normalised.

    Raises:
        LogsRefused: the answer is no such list, or one of its logs cannot exist.
    """
    try:
        answer = _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise LogsRefused(f"the detector's answer is not a log list: {error}") from None
    return tuple(_checked(number, log) for number, log in enumerate(answer))


def _checked(number: int, log: _Log) -> LogObservation:
    norm = math.hypot(*log.axis)
    if not all(map(math.isfinite, (*log.position_m, norm, log.length_m, log.diameter_m))) or norm < 1e-6:
        raise LogsRefused(f"log {number} has a value that is not finite or an axis without a direction")
    if not 0.0 < log.diameter_m < log.length_m:
        raise LogsRefused(f"log {number} is {log.length_m:g} m long and {log.diameter_m:g} m wide, which is no log")
    axis = (log.axis[0] / norm, log.axis[1] / norm, log.axis[2] / norm)
    return LogObservation(number, log.position_m, axis, log.length_m, log.diameter_m)
