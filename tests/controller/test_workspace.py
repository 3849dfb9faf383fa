"""Where the boom tip may go: ground, stakes and the profile's boxes; a setpoint that leads there is refused."""

import itertools

import msgspec
import pytest

from can_dbc.messages.crane import Knot
from controller.crane.trajectory_check import MAX_KNOTS_CHECKED, WorkspaceCheck
from controller.requests import RequestRefused
from machine.geometry.bunk import stake_walls
from machine.geometry.grapple import FIXED_GROUND_M
from machine.geometry.kinematics import Unreachable, pin_position, solve
from machine.loading.profile_file import load_profile
from machine.profile import KeepOut
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.controller.bench import PROFILE, Bench, settings_of

KIN = PROFILE.kinematics
HANG_M = KIN.hanger_to_fork_m + KIN.fork_to_rotator_m
STILL = (0.0,) * 5
ABOVE = (-1.8, 4.4, 0.5)


def solved(point):
    return (*solve(PROFILE, *point), 0.0)


def knots(*points):
    return [Knot(i * 50_000_000, solved(p), STILL) for i, p in enumerate(points)]


def refusal(check, *points):
    """The reason why a new check refuses a way that begins at the first point, where the reference is."""
    check.forget()
    try:
        check.check(solved(points[0]), knots(*points))
    except RequestRefused as refused:
        return refused.reason
    return Reason.NONE


def test_ground_is_refused_from_above_and_a_way_out_is_not():
    """The open grapple may stand a little lower than the ground should be; a closed one never comes there."""
    check = WorkspaceCheck(PROFILE)
    lowest = PROFILE.workspace.ground_z_m - FIXED_GROUND_M + PROFILE.grapple.jaws.tip_below_pin_m[0]
    x, y, _ = ABOVE
    assert refusal(check, ABOVE, (x, y, lowest + 0.01)) is Reason.NONE
    assert refusal(check, ABOVE, (x, y, lowest - 0.01)) is Reason.BELOW_GROUND
    assert refusal(check, (x, y, lowest - 0.2), (x, y, lowest - 0.1)) is Reason.NONE, "upward out of the ground"
    assert refusal(check, (x, y, lowest - 0.1), (x, y, lowest - 0.2)) is Reason.BELOW_GROUND


@pytest.mark.parametrize("row", [0, 1])
def test_stakes_are_refused_and_their_number_is_told(row):
    check, wall = WorkspaceCheck(PROFILE), stake_walls(PROFILE.bunk)[row]
    x, y, z = wall.center_m
    top = z + wall.half_m[2]
    with pytest.raises(RequestRefused) as refused:
        check.check(solved((x, y, top + 1.0)), knots((x, y, top + 1.0), (x, y, top + HANG_M - 0.02)))
    assert (refused.value.reason, refused.value.detail) == (Reason.KEEP_OUT, row)
    assert refusal(check, (x, y, top + 1.0), (x, y, top + HANG_M + 0.02)) is Reason.NONE, "over the stakes"
    bunk = PROFILE.bunk.center_m
    assert refusal(check, (*bunk, top + 1.0), (*bunk, top + HANG_M - 0.3)) is Reason.NONE, "between them"


def test_boxes_of_the_profile_are_turned_and_a_crane_inside_may_leave():
    box = KeepOut((-1.8, 4.4, 0.5), (1.0, 0.1, 0.3), 0.7853981633974483)
    check = WorkspaceCheck(msgspec.structs.replace(PROFILE, keep_out={"cabin": box}))
    along, across = (-1.8 + 0.6, 4.4 + 0.6, 0.5), (-1.8 + 0.6, 4.4 - 0.6, 0.5)
    high = (-1.8, 4.4, 1.6)
    assert refusal(check, high, along) is Reason.KEEP_OUT
    assert refusal(check, high, across) is Reason.NONE
    assert refusal(check, along, high) is Reason.NONE and refusal(check, along, (-1.8, 4.4, 0.5)) is Reason.NONE


def test_no_more_knots_than_promised_are_checked_and_the_last_always(monkeypatch):
    asked = []
    check = WorkspaceCheck(PROFILE)
    monkeypatch.setattr(
        "controller.crane.trajectory_check.pin_position", lambda kin, q: asked.append(q) or pin_position(kin, q)
    )
    for n in range(1, 17):
        asked.clear()
        path = knots(*[(x * 0.01 - 1.8, 4.4, 0.5) for x in range(n)])
        check.check(path[0].position, path)
        assert len(asked) <= 2 + MAX_KNOTS_CHECKED, "the reference's place and the first knot besides"
        assert path[0].position in asked and path[-1].position in asked


def test_what_lies_between_two_places_is_looked_at():
    """A box of 20 cm between two knots that lie 3 m apart, and one between the reference and the only knot."""
    box = KeepOut((-1.8, 4.4, 0.5), (0.1, 0.5, 0.3))
    check = WorkspaceCheck(msgspec.structs.replace(PROFILE, keep_out={"pole": box}))
    left, right = (-3.3, 3.8, 0.5), (-0.3, 4.8, 0.5)
    assert refusal(check, left, left, right) is Reason.KEEP_OUT
    with pytest.raises(RequestRefused):
        check.check(solved(left), knots(right))


def test_setpoints_that_each_lead_a_little_deeper_lead_nowhere():
    """Under the ground, where a hand lever left it, 0.9 mm a time: only the first until the machine is disarmed."""
    check = WorkspaceCheck(PROFILE)
    lowest = PROFILE.workspace.ground_z_m - FIXED_GROUND_M + PROFILE.grapple.jaws.tip_below_pin_m[0]
    x, y, _ = ABOVE

    def step(z):
        check.check(solved((x, y, z)), knots((x, y, z - 0.0009)))

    step(lowest - 0.1)
    with pytest.raises(RequestRefused):
        step(lowest - 0.1009)
    check.forget()
    step(lowest - 0.1009)


def test_the_controller_refuses_such_a_setpoint_and_keeps_what_it_does():
    bench = Bench().armed()
    bench.tick([bench.hold()])
    box = pin_position(KIN, bench.q)
    keep_out = {"pole": KeepOut((box[0], box[1], box[2] - 0.5), (0.05, 0.05, 0.05))}
    profile = msgspec.structs.replace(PROFILE, keep_out=keep_out)
    bench = Bench(settings_of(profile)).armed()
    bench.tick([bench.hold()])
    start = list(bench.controller.reference_position)
    down = [start[0], start[1] - 0.02, *start[2:]]
    refused = bench.controller.gate.refused
    bench.tick([bench.setpoint([(0, start, STILL), (1000, down, STILL)])])
    assert bench.controller.gate.refusal is Reason.KEEP_OUT and bench.controller.gate.refused == refused + 1
    assert bench.mode is Mode.ACTIVE
    up = [start[0], start[1] + 0.02, *start[2:]]
    bench.tick([bench.setpoint([(0, start, STILL), (1000, up, STILL)])])
    assert bench.controller.gate.refused == refused + 1


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_work_places_of_the_shipped_machines_stay_free(name):
    """The pin over every place where logs lie and in the bunk, as low as the closed jaws just reach the ground."""
    profile = load_profile(name)
    check, site, bunk = WorkspaceCheck(profile), profile.workspace, profile.bunk
    jaws = max(profile.grapple.jaws.tip_below_pin_m) - 0.35
    x, y = site.pick_center_m
    spread = (-site.pick_half_size_m, 0.0, site.pick_half_size_m)
    places = [(x + a, y + b, site.ground_z_m + jaws) for a, b in itertools.product(spread, spread)]
    places += [(*bunk.center_m, bunk.floor_z_m + jaws)]
    tried = 0
    for place in places:
        try:
            start, end = (solve(profile, place[0], place[1], z) for z in (place[2] + 1.0, place[2]))
        except Unreachable:
            continue
        check.check((*start, 0.0), [Knot(0, (*start, 0.0), STILL), Knot(50_000_000, (*end, 0.0), STILL)])
        tried += 1
    assert tried > 5
