"""What the plan page is told about a mission: errors and warnings with the part that each is about, time and wood.

The checks are those of ``timberhand plan check``.  Pure; a large mission takes seconds.
"""

from __future__ import annotations

from typing import Any

import msgspec

from autonomy.missions.mission_file import read
from autonomy.missions.model import ForwardingMission
from autonomy.missions.review import review
from autonomy.missions.validation import Finding, problems_of
from machine.profile import Carrier, Profile

MAX_FINDINGS = 100


class DocumentRefused(ValueError):
    """The page's mission does not match the schema; the message is one sentence."""


def mission_of(body: bytes) -> ForwardingMission:
    """The mission in a request.

    Raises:
        DocumentRefused: it is not JSON, or a field is unknown, missing or of the wrong type.
    """
    try:
        return msgspec.json.decode(body, type=ForwardingMission)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        reason = str(error)[:200].rstrip(".")
        raise DocumentRefused(f"This is not a mission of this page: {reason}.") from None


def site_of(carrier: Carrier) -> tuple[float, float]:
    """Latitude and longitude [deg] of the machine's site."""
    return carrier.site_lat_deg, carrier.site_lon_deg


def reviewed(mission: ForwardingMission, profile: Profile) -> dict[str, Any]:
    """Errors, warnings and, of a mission that can be driven, the estimate."""
    assert profile.carrier is not None
    found = problems_of(mission, True, site_of(profile.carrier))
    answer: dict[str, Any] = {"errors": _told(found), "warnings": [], "estimate": None, "wood": wood(mission)}
    if not found:
        figures = review(mission, profile)
        answer["warnings"] = _told(list(figures.warnings))
        answer["estimate"] = {
            "length_m": round(figures.length_m, 1),
            "drive_s": round(figures.drive_s),
            "crane_s": round(figures.crane_s),
            "total_s": round(figures.total_s),
            "logs": figures.logs,
        }
    return answer


def wood(mission: ForwardingMission) -> dict[str, Any]:
    """Listed logs, their volume, how many have no size, and their kinds."""
    volumes = [log.volume_m3 for log in mission.logs]
    return {
        "logs": len(volumes),
        "volume_m3": round(sum(v for v in volumes if v is not None), 3),
        "unsized": sum(v is None for v in volumes),
        "kinds": sorted({log.assortment or log.species for log in mission.logs} - {""})[:20],
    }


def imported(data: bytes, name: str) -> dict[str, Any]:
    """The mission in a file of any format; its errors are found by the check that follows.

    Raises:
        MissionError: it cannot be read as a mission.
    """
    draft = read(data, name)
    notes = [*(problem.sentence for problem in draft.warnings), *draft.notes]
    return {"mission": msgspec.to_builtins(draft.mission), "format": draft.format, "notes": notes}


def _told(findings: list[Finding]) -> list[dict[str, Any]]:
    return [
        {"code": f.code, "sentence": f.sentence, "part": None if f.key is None else list(f.key)}
        for f in findings[:MAX_FINDINGS]
    ]
