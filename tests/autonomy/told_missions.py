"""Mission files that are refused, and those that are not."""

from __future__ import annotations

from pathlib import Path

import pytest
from mission_texts import ROUTE

from autonomy.missions.features import Draft
from autonomy.missions.mission_file import read, verify
from autonomy.missions.model import ForwardingMission, MissionError

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def told(data: bytes, **how: object) -> str:
    """What is said of a file that is refused."""
    with pytest.raises(MissionError) as refused:
        verify(read(data, "m"), **how)  # type: ignore[arg-type]
    return str(refused.value)


def good(data: bytes) -> Draft:
    """A file that is not refused."""
    draft = read(data, "m")
    verify(draft)
    return draft


def assert_route(mission: ForwardingMission) -> None:
    assert [(p.latitude_deg, p.longitude_deg) for p in mission.waypoints] == [
        pytest.approx((p.latitude_deg, p.longitude_deg), abs=1e-12) for p in ROUTE
    ]
