"""A recording in the page: it plays, pauses and seeks, and nothing can be commanded."""

from __future__ import annotations

import json

import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from console.can_tap import load_databases
from console.replay import Overview, ReplayView
from console.replay_server import REFUSAL, create_replay_app
from machine.status.explanation import explain
from machine.status.reasons import Reason, pack
from tests.console.recorded_run import BEGIN_NS, LENGTH_S, PROFILE, STOP_S, RecordedRun

S = 10**9
BEGIN_S = BEGIN_NS / 1e9
HERE = "http://127.0.0.1:8471"


@pytest.fixture
def view() -> ReplayView:
    run = RecordedRun()
    return ReplayView(run, PROFILE, Overview(run, PROFILE), load_databases(PROFILE), BEGIN_NS + 10 * S)


def at_s(state: dict) -> float:
    return state["replay"]["at_s"] - BEGIN_S


def test_a_page_begins_where_it_is_told_and_stands_still(view: ReplayView) -> None:
    first = view.step(0)
    json.dumps(first, allow_nan=False)
    assert at_s(first) == 10 and first["mode"] == "ACTIVE" and first["alive"]
    assert first["position"][0] == pytest.approx(0.1, abs=0.001)
    assert at_s(view.step(100 * S)) == 10


def test_it_plays_at_its_speed_and_stands_at_the_end(view: ReplayView) -> None:
    view.step(0)
    assert view.order("play") and view.order("speed 4")
    later = view.step(S)
    assert at_s(later) == 14 and later["position"][0] == pytest.approx(0.14, abs=0.001)
    view.order("pause")
    assert at_s(view.step(3 * S)) == 14
    view.order("play")
    last = view.step(90 * S)
    assert at_s(last) == LENGTH_S and not last["replay"]["playing"]
    view.order("play")
    assert at_s(view.step(91 * S)) == pytest.approx(4)  # from the beginning again


def test_a_seek_shows_the_state_and_the_plot_of_then(view: ReplayView) -> None:
    view.step(0)
    view.order(f"seek {BEGIN_S + STOP_S + 1}")
    stopped = view.step(0)
    assert stopped["mode"] == "STOP" and explain(pack(Reason.JOINT_STUCK, 1)).sentence[:-1] in stopped["reason"]
    times = [t for t, _ in stopped["history"]]
    assert times[0] == pytest.approx(BEGIN_S + STOP_S - 19) and len(times) == 200
    assert stopped["history"][0][1][0] == pytest.approx(10.0)  # mrad
    assert "history" not in view.step(0)
    view.order(f"seek {BEGIN_S + 3}")
    assert view.step(0)["mode"] == "ACTIVE"
    for beyond, nearer in ((-1e6, 0), (1e6, LENGTH_S)):
        view.order(f"seek {beyond:.1f}")
        assert at_s(view.step(0)) == nearer


def test_a_run_with_more_entries_than_are_kept_is_told_by_the_number_of_the_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The page asks for the timeline until it has that one."""
    monkeypatch.setattr("console.replay.MAX_ENTRIES", 1)
    run = RecordedRun()
    overview = Overview(run, PROFILE)
    told = ReplayView(run, PROFILE, overview, {}).step(0)["entries"]
    assert len(overview.entries) == 1 and told == overview.entries[-1]["n"] > 1


@pytest.mark.parametrize(
    "text", ["", "seek", "play 3", "seek nan", "seek 1e9", "speed", "arm", "seek 1 2", "panel  can"]
)
def test_other_words_change_nothing(view: ReplayView, text: str) -> None:
    assert not view.order(text)
    assert at_s(view.step(0)) == 10


def test_the_can_table_is_that_of_then(view: ReplayView) -> None:
    view.step(0)
    view.order("panel can")
    (crane,) = view.step(S)["can"]
    assert [row["name"] for row in crane["rows"]] == ["EncLift"]
    assert crane["rows"][0]["rate_hz"] in (49, 50) and crane["load_pct"] > 0


def test_every_command_is_refused_and_foreign_names_too() -> None:
    client = TestClient(create_replay_app(RecordedRun(), PROFILE), base_url=HERE, client=("127.0.0.1", 40000))
    for path in ("operator/stop", "operator/arm", "mission/pause", "watch-end/x", "faults/encoder"):
        answer = client.post(f"/api/{path}")
        assert (answer.status_code, answer.text) == (409, REFUSAL)
    assert client.get("/api/machine", headers={"host": "evil.example"}).status_code == 403
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/ws", headers={"origin": "http://evil.example"}):
        pass
    with client.websocket_connect("ws://127.0.0.1:8471/ws") as ws:
        state = ws.receive_json()
        assert not (state["may_stop"] or state["may_command"] or state["may_order"])
