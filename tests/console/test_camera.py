"""The camera on the console: a detector is asked only for a page, and every state has its sentence."""

from __future__ import annotations

import math

import msgspec
import pytest
from starlette.testclient import TestClient

from can_dbc.messages.mission import ChosenGrasp, encode_grasp
from can_dbc.messages.picture import PictureFacts, PictureLog, encode_picture
from console.access import VISITOR
from console.camera import NO_CAMERA, NO_DETECTOR, NO_PICTURE, SILENT, SILENT_NS, WAITING, CameraState
from console.console import Console
from console.server import create_app
from console.state import TIMEOUT_NS, GraspState
from machine.geometry import grapple
from machine.loading.profile_file import load_profile, profile_hash
from tests.console.played_detector import detector

PROFILE = load_profile("palms_471")
HASH = profile_hash(PROFILE)
HERE = "http://127.0.0.1:8471"
JPEG = b"\xff\xd8\xff" + b"picture\n" * 9
# At the base frame's origin, looking along base y: x right is base x, y down is base -z.
FACTS = PictureFacts(
    1,
    "stick",
    7,
    "",
    640,
    360,
    300.0,
    300.0,
    320.0,
    180.0,
    (0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0),
    (PictureLog(3, ((10.0, 20.0), (30.0, 40.0)), 2.5, 0.2, True),),
)
GRASP = ChosenGrasp(1, (0.0, 4.0, 1.5), 0.0, (3,), "log 3 alone")
PLACE = {"x_m": 1.0, "y_m": 2.0, "front_rad": 0.1, "rear_rad": 0.1}


def grasp_seen() -> GraspState:
    state = GraspState(PROFILE, HASH, None)
    assert state.shown(0) is None and state.on_grasp(encode_grasp(GRASP, 1, HASH, 1), 0)
    return state


def grasp_shown() -> dict:
    shown = grasp_seen().shown(0)
    assert shown is not None
    return shown


def test_a_grasp_is_shown_with_the_tips_of_the_open_jaws_until_it_is_old() -> None:
    shown, jaws = grasp_shown(), PROFILE.grapple.jaws
    (a, b), half = shown["tips"], grapple.half_gap_m(jaws, 0.0)
    assert a == pytest.approx([-half, 4.0, 1.5 - grapple.tip_below_pin_m(jaws, 0.0)], abs=1e-3)
    assert b[0] == -a[0] and shown["logs"] == [3]
    assert grasp_seen().shown(TIMEOUT_NS) and grasp_seen().shown(TIMEOUT_NS + 1) is None


def test_a_grasp_of_another_machine_or_without_the_key_is_not_shown() -> None:
    assert not GraspState(PROFILE, HASH, None).on_grasp(encode_grasp(GRASP, 1, HASH + 1, 1), 0)
    assert not GraspState(PROFILE, HASH, b"key").on_grasp(encode_grasp(GRASP, 1, HASH, 1), 0)


def test_the_grasp_is_projected_into_the_picture() -> None:
    state = CameraState()
    state.on_reply(encode_picture(FACTS, JPEG), 10, None)
    page = state.page(10**9, grasp_shown(), None)
    (ax, ay), (bx, by) = page["grasp"]["tips_px"]
    half, z = grapple.half_gap_m(PROFILE.grapple.jaws, 0.0), 1.5 - grapple.tip_below_pin_m(PROFILE.grapple.jaws, 0.0)
    assert (ax, bx) == (pytest.approx(320 - 75 * half, abs=0.1), pytest.approx(320 + 75 * half, abs=0.1))
    assert ay == by == pytest.approx(180 - 75 * z, abs=0.1)
    assert (page["picture"], page["age_s"], page["words"], page["logs"][0]["id"]) == (7, 1.0, "", 3)


@pytest.mark.parametrize(("name", "by"), [("x_m", 0.2), ("front_rad", 0.05), ("rear_rad", -0.05)])
def test_no_grasp_is_drawn_into_a_picture_from_elsewhere(name: str, by: float) -> None:
    state = CameraState()
    state.on_reply(encode_picture(FACTS, JPEG), 10, PLACE)
    assert state.page(20, grasp_shown(), PLACE)["grasp"]["tips_px"]
    away = state.page(20, grasp_shown(), PLACE | {name: PLACE[name] + by})
    assert away["moved"] and away["grasp"]["tips_px"] is None
    assert not state.page(20, grasp_shown(), PLACE | {name: PLACE[name] + math.tau})["moved"] or name == "x_m"


def test_every_state_without_a_picture_has_its_words() -> None:
    state = CameraState()
    state.request(5)
    assert state.page(6, None, None) == {"picture": 0, "words": WAITING}
    assert state.page(SILENT_NS + 6, None, None)["words"] == SILENT
    state.on_reply(b'{"error":"unknown op"}', 10, None)
    assert state.page(11, None, None)["words"] == NO_CAMERA
    state.on_reply(encode_picture(PictureFacts(1, "stick", 0, "")), 12, None)
    assert state.page(13, None, None)["words"] == NO_PICTURE
    state.on_reply(encode_picture(PictureFacts(1, "stick", 0, "the lens is covered")), 14, None)
    assert "the lens is covered" in state.page(15, None, None)["words"]
    state.on_reply(encode_picture(FACTS, JPEG), 16, None)
    state.on_reply(encode_picture(PictureFacts(1, "stick", 7, "unplugged")), 17, None)
    page = state.page(18, None, None)
    assert (page["picture"], page["words"]) == (7, "unplugged") and state.jpegs == {7: JPEG}
    state.request(18)
    assert state.page(18 + SILENT_NS + 1, None, None)["words"] == SILENT


@pytest.mark.parametrize("last", [b"no picture", encode_picture(PictureFacts(1, "stick", 0, ""))])
def test_a_detector_that_has_ended_before_its_first_picture_is_told_as_silent(last: bytes) -> None:
    state = CameraState()
    state.request(5)
    state.on_reply(last, 6, None)
    for at_ns in range(10, SILENT_NS + 20, SILENT_NS // 5):
        state.request(at_ns)
    assert state.page(SILENT_NS + 20, None, None)["words"] == SILENT


def test_a_detector_that_was_not_asked_for_a_while_is_not_told_as_silent() -> None:
    state = CameraState()
    state.request(5)
    state.on_reply(encode_picture(FACTS, JPEG), 6, None)
    state.request(7)  # its answer is lost, and the page shows another panel
    state.request(10 * SILENT_NS)
    assert state.page(10 * SILENT_NS + 1, None, None)["words"] == ""


def test_the_picture_is_served_and_the_detector_is_asked_at_most_twice_a_second() -> None:
    now = [10**9]
    with detector(encode_picture(FACTS, JPEG)) as (address, asked):
        console = Console(PROFILE, HASH, scene=address, clock=lambda: now[0])
        with TestClient(create_app(console), base_url=HERE) as client:
            assert not asked, "no page, no request"
            for _ in range(10):
                assert client.get("/api/camera").json()["picture"] == 7
            assert asked == [0]
            now[0] += 500_000_000
            client.get("/api/camera")
            assert asked == [0, 7]
            picture = client.get("/api/camera/7")
            assert picture.content == JPEG and picture.headers["content-type"] == "image/jpeg"
            assert client.get("/api/camera/6").status_code == 404


def test_the_picture_before_the_newest_can_still_be_fetched() -> None:
    state = CameraState()
    for n in (7, 8, 9):
        state.on_reply(encode_picture(msgspec.structs.replace(FACTS, measured_ns=n), JPEG), n, None)
    assert sorted(state.jpegs) == [8, 9]


def test_a_console_without_a_detector_says_so() -> None:
    with TestClient(create_app(Console(PROFILE, HASH)), base_url=HERE) as client:
        assert client.get("/api/camera").json() == {"picture": 0, "words": NO_DETECTOR}
        assert client.get("/api/camera/0").status_code == 404
        assert "camera" in client.get("/api/machine").json()["panels"]


def test_the_state_has_the_chosen_grasp() -> None:
    console = Console(PROFILE, HASH, clock=lambda: 10**9)
    assert console.crane_state.on_report(encode_grasp(GRASP, 1, HASH, 1), 10**9)
    assert console.state_for(None, VISITOR)["grasp"]["reason"] == "log 3 alone"
