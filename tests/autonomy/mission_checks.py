"""Mission files that are refused, with the codes and places of their problems, and files that are accepted."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from autonomy.missions.features import Draft
from autonomy.missions.mission_file import read, verify
from autonomy.missions.model import ForwardingMission, MissionError
from tests.autonomy.mission_texts import ROUTE

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def refused(data: bytes, name: str = "m", **how: object) -> MissionError:
    """The error of a file that is refused."""
    with pytest.raises(MissionError) as caught:
        verify(read(data, name), **how)
    return caught.value


def codes(data: bytes, **how: object) -> list[str]:
    """The codes of all problems of a file, without the prefix ``mission.``."""
    return [problem.code.removeprefix("mission.") for problem in refused(data, **how).problems]


def peak_bytes(data: bytes) -> tuple[list[str], int]:
    """The codes of a file that is refused, and the memory that it took."""
    tracemalloc.start()
    try:
        return codes(data), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def place(data: bytes) -> str:
    """``file:line`` of the first problem of a file."""
    return refused(data).problems[0].place


def good(data: bytes) -> Draft:
    """A file that is accepted."""
    draft = read(data, "m")
    verify(draft)
    return draft


def assert_route(mission: ForwardingMission) -> None:
    """The mission's waypoints are ``ROUTE``."""
    assert [(p.latitude_deg, p.longitude_deg) for p in mission.waypoints] == [
        pytest.approx((p.latitude_deg, p.longitude_deg), abs=1e-12) for p in ROUTE
    ]
