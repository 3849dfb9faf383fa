"""The desk at which a page orders faults: only what it offers, only in a run whose buses are emulated."""

from __future__ import annotations

import json
import socket
import stat
import threading
from pathlib import Path

import pytest

from hil.faults import __main__
from hil.faults.__main__ import OFFERS, Desk, answer
from hil.faults.table import FAULTS, Order, parse
from hil.harness.live import ADDRESSES


def run_at(folder: Path, bus: str = "wire:crane0") -> Path:
    document = {"profile": "palms_471", "ports": {"sim": 1, "control": 2}, "buses": {"crane0": bus}, "pids": {}}
    document["key_file"] = "key"
    (folder / ADDRESSES).write_text(json.dumps(document))
    return folder


@pytest.fixture
def injected(monkeypatch: pytest.MonkeyPatch) -> list[Order]:
    found: list[Order] = []

    def inject(order: Order, *_: object) -> str:
        found.append(order)
        return "begun"

    monkeypatch.setattr(__main__, "inject", inject)
    return found


def test_every_offer_is_an_order_that_a_live_run_can_do_and_that_ends() -> None:
    for offer in OFFERS.values():
        order = parse(offer.order)
        assert not FAULTS[order.fault].not_live and order.length_s <= 2.0, offer


def test_an_offer_is_injected_and_answered_with_its_time(tmp_path: Path, injected: list[Order]) -> None:
    told = answer({"op": "inject", "name": "estop"}, run_at(tmp_path))
    assert told["said"] == "begun" and told["at_ns"] > 0 and told["title"] == OFFERS["estop"].title
    assert [order.fault for order in injected] == ["estop-pressed"]


def test_the_first_run_after_a_start_finds_no_folder_and_makes_it(tmp_path: Path) -> None:
    with Desk(tmp_path / "memory" / "user" / "desk", run_at(tmp_path)):
        assert (tmp_path / "memory/user/desk").is_socket()


@pytest.mark.parametrize("bus", ["socketcan:can0", "socketcan:vcan7", "pcan:1", ""])
def test_a_bus_that_may_be_a_machine_gets_nothing(tmp_path: Path, injected: list[Order], bus: str) -> None:
    for request in ({"op": "inject", "name": "estop"}, {"op": "list"}):
        assert set(answer(request, run_at(tmp_path, bus))) == {"error"}
    assert not injected


@pytest.mark.parametrize("request_", [{"op": "inject", "name": "bus-babble"}, {"op": "inject"}, {"op": "run"}, {}])
def test_nothing_else_is_done(tmp_path: Path, injected: list[Order], request_: dict) -> None:
    assert set(answer(request_, run_at(tmp_path))) == {"error"} and not injected


def test_what_needs_the_wire_is_not_offered_on_a_vcan(tmp_path: Path) -> None:
    told = answer({"op": "list"}, run_at(tmp_path, "socketcan:vcan0"))["faults"]
    assert {f["name"] for f in told if f["why_not"]} == {"bus-cut", "frames-corrupt"}


def test_the_socket_is_of_this_user_alone_and_answers_nonsense(tmp_path: Path) -> None:
    path = tmp_path / "desk"
    with Desk(path, run_at(tmp_path)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        told = []
        for words in (b"nonsense\n", b"[1]\n", b'{"op": "list"}\n'):
            with socket.socket(socket.AF_UNIX) as client:
                client.connect(str(path))
                client.sendall(words)
                told.append(json.loads(client.makefile().readline()))
        server.shutdown()
        thread.join()
    assert [set(each) for each in told] == [{"error"}, {"error"}, {"faults"}]
