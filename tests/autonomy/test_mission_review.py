"""Review of a mission for a machine: lengths, times, corners and warnings."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import Fence, ForwardingMission, KnownLog, MissionError, Options, Point
from autonomy.missions.review import LOG_S, MIN_SWITCH_M, Review, review
from autonomy.missions.validation import SWAPPED_HINT
from machine.geometry.carrier import turning_radius_m
from machine.loading.profile_file import load_profile
from tests.autonomy.mission_texts import FENCE, at
from tests.codes import coded, numbers_in

AORO = load_profile("aoro_fc8")
assert AORO.carrier is not None
CARRIER = AORO.carrier
RADIUS = turning_radius_m(CARRIER, CARRIER.articulation_limit_rad)
SQUARE = [(-20, -15), (20, -15), (20, 15), (-20, 15)]
YARD = Fence(tuple(at(*c) for c in ((-60, -60), (60, -60), (60, 60), (-60, 60))))


def reviewed(
    points: list[tuple[float, float]], *logs: KnownLog, fences: tuple[Fence, ...] = (YARD,), **options: object
) -> Review:
    """The review of a route in metres east and north of the site."""
    way = tuple(at(*p) for p in points)
    return review(ForwardingMission("way", way, fences, (), logs, Options(**options)), AORO)


def test_paper_bs_mission_has_no_warnings() -> None:
    mission = load_mission(Path(__file__).parents[2] / "docs" / "examples" / "paper_b.geojson").mission
    found = review(mission, AORO)
    assert found.length_m == pytest.approx(2 * (40 + 30 + 40 + 30) - 30, abs=0.01)
    assert found.drive_s == pytest.approx(found.length_m / 0.639)
    assert (found.logs, found.crane_s) == (24, 24 * LOG_S)
    assert found.warnings == ()
    for corner in found.corners:
        assert math.degrees(corner.turn_rad) == pytest.approx(90.0, abs=0.01)
        assert corner.switch_m == pytest.approx(RADIUS, abs=0.01)  # R tan(45 degrees)


def test_a_closed_route_has_a_corner_at_every_waypoint() -> None:
    assert [c.waypoint for c in reviewed(SQUARE).corners] == [1, 2]
    assert sorted(c.waypoint for c in reviewed(SQUARE, laps=2).corners) == [0, 1, 2, 3]
    assert reviewed(SQUARE[:1]).length_m == 0.0
    closed = reviewed([*SQUARE, SQUARE[0]], laps=3)
    assert closed.length_m == pytest.approx(3 * 140.0, abs=0.01)


def test_gentle_corners_are_switched_at_the_least_distance() -> None:
    assert reviewed([(0, 0), (20, 0), (40, 5)]).corners[0].switch_m == MIN_SWITCH_M


def test_legs_too_short_for_their_corners() -> None:
    (warning,) = reviewed([(0, 0), (30, 0), (30, 10), (0, 10)]).warnings
    assert warning.code == "mission.short-leg"
    assert {2, 3, 10.0, round(2 * RADIUS, 1), round(RADIUS, 1)} <= set(numbers_in(warning.sentence))
    assert not reviewed([(0, 0), (30, 0), (30, 2 * RADIUS + 0.1), (0, 2 * RADIUS + 0.1)]).warnings


def test_a_turn_on_the_spot() -> None:
    (warning,) = reviewed([(0, 0), (30, 0), (0, 1)]).warnings
    assert warning.code == "mission.turn-on-the-spot"
    assert {2, 178, round(RADIUS, 1)} <= set(numbers_in(warning.sentence))


def test_near_the_fence_without_a_fence_and_too_fast() -> None:
    edge = reviewed([(-20, -24), (20, -24)], fences=(Fence(tuple(FENCE)),))
    assert edge.warnings[0].code == "mission.close-to-fence"
    assert {1, 2.7} <= set(numbers_in(edge.warnings[0].sentence))
    assert reviewed(SQUARE, fences=()).warnings[0].code == "mission.no-fence"
    assert reviewed(SQUARE, speed_m_s=2.0).warnings[0].code == "mission.speed-limit"
    assert reviewed(SQUARE, transport_height_m=0.9).warnings[0].code == "mission.height-limit"


def test_logs_out_of_reach_and_under_the_wheels() -> None:
    far, under, vague = KnownLog(at(0, 0)), KnownLog(at(0, -14.5)), KnownLog(at(0, -14.5), sigma_m=4.0)
    warnings = reviewed(SQUARE, far, under, vague).warnings
    assert [w.code for w in warnings] == ["mission.log-out-of-reach", "mission.log-on-route"]
    assert {1, 15.0, 9.0} <= set(numbers_in(warnings[0].sentence))
    assert 2 in numbers_in(warnings[1].sentence)
    many = reviewed(SQUARE, *[far] * 20).warnings
    assert len(many) == 6 and 15 in numbers_in(many[-1].sentence)


def test_the_number_of_logs_to_collect() -> None:
    logs = [KnownLog(at(0, -12), assortment=name) for name in ("a", "a", "b")]
    assert reviewed(SQUARE, *logs).logs == 3
    assert reviewed(SQUARE, *logs, laps=2).logs == 6  # searched for, and laid again for every lap
    assert reviewed(SQUARE, *logs, laps=2, logs="listed").logs == 3
    assert reviewed(SQUARE, *logs, assortments=("a",)).logs == 2
    assert reviewed(SQUARE, *logs, logs_wanted=1).logs == 1
    assert reviewed(SQUARE, logs_wanted=7).logs == 7


def test_an_assortment_without_logs() -> None:
    log = KnownLog(at(0, -12), assortment="pulpwood")
    warnings = reviewed(SQUARE, log, assortments=("pulpwood", "pulp wood"), logs="listed").warnings
    assert [w.code for w in warnings] == ["mission.unlisted-assortment"] and '"pulp wood"' in warnings[0].sentence


def test_another_country_and_a_machine_that_does_not_drive() -> None:
    chile = ForwardingMission("", (Point(-38.0, -72.0), Point(-38.0, -72.001)), (), (), ())
    assert review(chile, AORO).warnings[0].code == "mission.far-from-site"
    swapped = ForwardingMission("", (Point(15.0, 60.0), Point(15.0, 60.001)), (), (), ())  # 15 E, 60 N is in Sweden
    (warning, *_) = review(swapped, AORO).warnings
    assert warning.code == "mission.swapped-axes" and SWAPPED_HINT in warning.sentence
    with pytest.raises(MissionError, check=coded("mission.stationary-machine")):
        review(chile, load_profile("palms_471"))


def test_a_warning_names_the_part_that_it_is_about() -> None:
    found = reviewed([(0, 0), (30, 0), (0, 1)], KnownLog(at(0, 30)), fences=())
    assert [(w.code.removeprefix("mission."), w.key) for w in found.warnings] == [
        ("turn-on-the-spot", ("waypoint", 1)),
        ("no-fence", None),
        ("log-out-of-reach", ("log", 0)),
    ]
