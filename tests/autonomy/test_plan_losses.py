"""What a QGroundControl plan means and a mission cannot hold: its speeds, its fences, its frames."""

from __future__ import annotations

from typing import Any

import pytest

from tests.autonomy.mission_checks import codes, good
from tests.autonomy.mission_texts import FENCE, ROUTE, at, item, plan


def speed(value: float, kind: int = 1) -> dict[str, Any]:
    """A DO_CHANGE_SPEED."""
    return {"type": "SimpleItem", "command": 178, "frame": 2, "params": [kind, value, -1, 0, 0, 0, 0]}


A, B, C = map(item, ROUTE)
SEVERAL, KIND = "plan.several-speeds", "plan.speed-type"


@pytest.mark.parametrize(
    ("items", "speed_m_s", "warned"),
    [
        ([A, B, C], None, []),
        ([speed(0.5), A, B, C], 0.5, []),
        ([A, speed(0.5), B, C], 0.5, []),
        ([speed(-1), A, B, C], None, []),
        ([speed(0.5), A, B, speed(-1), C], 0.5, []),
        ([speed(2.0), A, speed(0.5), B, C], 0.5, []),
        ([speed(0.9), A, B, speed(0.3), C], 0.3, [SEVERAL]),
        ([A, B, speed(0.3), C], 0.3, [SEVERAL]),
        ([speed(0.5), A, B, speed(-2), C], 0.5, [SEVERAL]),
        ([speed(0.5), A, B, C, speed(0.1)], 0.5, []),
        ([speed(0.5, 0), A, B, C], None, [KIND]),
        ([speed(0.5) | {"params": [1, 0.5, -1, 1, 0, 0, 0]}, A, B, C], None, [KIND]),  # relative to the speed before
        ([speed(0.5) | {"params": [1, None, -1, 0, 0, 0, 0]}, A, B, C], None, [KIND]),
        ([speed(0.5) | {"params": [1, "0.5"]}, A, B, C], None, [KIND]),
        ([speed(0.5) | {"params": [1]}, A, B, C], None, [KIND]),
        ([{"type": "SimpleItem", "command": 178}, A, B, C], None, [KIND]),
    ],
)
def test_speeds(items: list[dict[str, Any]], speed_m_s: float | None, warned: list[str]) -> None:
    draft = good(plan(items))
    assert draft.mission.options.speed_m_s == speed_m_s
    assert [problem.code for problem in draft.warnings] == warned


def test_a_speed_that_is_none_is_refused() -> None:
    assert codes(plan([speed(0.0), A, B, C])) == ["option-range"]


@pytest.mark.parametrize(("frame", "refused"), [(0, False), (3, False), (1, True), (2, True), (8, True), ("x", True)])
def test_the_frame_of_a_waypoint(frame: object, refused: bool) -> None:
    data = plan([A, B | {"frame": frame}, C])
    if refused:
        assert codes(data) == ["plan.frame"]
    else:
        good(data)


@pytest.mark.parametrize(("firmware", "warned"), [(3, ["plan.several-fences"]), (12, [])])
def test_several_keep_in_fences(firmware: int, warned: list[str]) -> None:
    inner = [at(-25, -20), at(25, -20), at(25, 20), at(-25, 20)]
    rings = [[[p.latitude_deg, p.longitude_deg] for p in ring] for ring in (FENCE, inner)]
    polygons = [{"inclusion": True, "polygon": ring} for ring in rings]
    data = plan([A, B, C], polygons=polygons).replace(b'"items"', b'"firmwareType": %d, "items"' % firmware, 1)
    draft = good(data)
    assert [problem.code for problem in draft.warnings] == warned and len(draft.notes) == 1


@pytest.mark.parametrize("inclusion", ["false", "true", None, 2, []])
def test_a_fence_that_does_not_say_its_side_is_refused(inclusion: object) -> None:
    ring = [[p.latitude_deg, p.longitude_deg] for p in FENCE]
    assert codes(plan([A, B, C], polygons=[{"inclusion": inclusion, "polygon": ring}])) == ["plan.geofence"]


def test_a_part_of_the_fence_that_is_not_read_is_a_warning() -> None:
    data = plan([A, B, C], circle={"center": [0, 0], "radius": 9}, future=[1], empty=[], breachReturn=[1, 2, 3])
    assert [problem.code for problem in good(data).warnings] == ["plan.geofence-part"] * 2


WAIT = A | {"params": [5, *A["params"][1:]]}


@pytest.mark.parametrize(
    ("extra", "warned", "noted"),
    [
        ([], 0, 0),
        ([item(ROUTE[0], 22)], 0, 1),  # a take-off
        ([item(at(0, 0), 19)], 1, 0),  # a loiter
        ([item(at(0, 0), 19), item(at(1, 0), 19), item(at(1, 0), 20)], 2, 0),  # and the way home
        ([{"type": "SimpleItem", "command": 177, "frame": 2, "params": [1, 3, 0, 0, 0, 0, 0]}], 1, 0),  # a jump
        ([{"type": "SimpleItem", "command": 112, "frame": 2, "params": [9, 0, 0, 0, 0, 0, 0]}], 1, 0),  # a delay
        ([{"type": "SimpleItem", "command": 206, "frame": 2, "params": [9, 0, 0, 0, 0, 0, 0]}], 0, 1),  # a camera
        ([{"type": "ComplexItem", "complexItemType": "survey"}], 1, 0),
        (
            [{"type": "SimpleItem", "command": 5001, "frame": 3, "params": [4, 0, 0, 0, 1, 2, 0]}],
            1,
            0,
        ),  # a fence's corner
        ([WAIT], 1, 0),
        ([A | {"autoContinue": False}], 1, 0),
        ([{"type": "SimpleItem", "command": "x" * 999}, {"type": "SimpleItem", "command": None}], 0, 2),
    ],
)
def test_items_that_are_no_waypoints(extra: list[dict[str, Any]], warned: int, noted: int) -> None:
    draft = good(plan([*extra, *([] if extra[:1] and extra[0].get("command") == 16 else [A]), B, C]))
    assert [problem.code for problem in draft.warnings] == ["plan.not-driven"] * warned and len(draft.notes) == noted
    assert len(draft.mission.waypoints) == 3
