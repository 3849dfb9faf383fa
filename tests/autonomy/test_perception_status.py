"""What systemd is told of the log detector: ready once it serves, alive while it does, and its rate."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from autonomy.perception import __main__ as process
from runtime.errors import LinkError
from runtime.notifier import Notifier
from tests.codes import numbers_in

S = 1_000_000_000


class Requests:
    """Makes a list each time it answers."""

    def __init__(self) -> None:
        self.lists, self.log_count, self.problem = 0, 3, ""

    def answer_waiting(self) -> None:
        self.lists += 1


def test_the_status_tells_logs_and_lists_per_second_or_the_trouble() -> None:
    requests, now = Requests(), iter((0, S, 3 * S, 4 * S))
    text = process.StatusText("stick", requests, lambda: next(now))
    assert numbers_in(text()) == []
    requests.lists = 9
    assert numbers_in(text()) == [3.0, 4.5]
    requests.problem = "trouble 77"
    assert numbers_in(text()) == [77.0]


def test_it_is_ready_when_it_serves_alive_while_it_does_and_says_that_it_ends(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.setblocking(False)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
            link.bind(("127.0.0.1", 0))
            link.sendto(b"x", link.getsockname())
            signals: list[int] = []

            class Ending(Requests):
                def answer_waiting(self) -> None:
                    super().answer_waiting()
                    signals.append(15)

            requests = Ending()
            notifier = Notifier(process.StatusText("stick", requests), str(tmp_path / "notify"))
            process.serve(link, requests, notifier, signals)
        first, last = systemd.recv(4096).decode(), systemd.recv(4096).decode()
    assert first.split("\n")[:2] == ["READY=1", "WATCHDOG=1"] and last.split("\n")[0] == "STOPPING=1"
    assert requests.lists == 1


@pytest.mark.parametrize(("code", "exit_code"), [("camera-source.not-opened", 4), ("camera-source.no-sdk", 3)])
def test_a_camera_that_is_not_there_now_is_tried_again_by_the_service(
    monkeypatch: pytest.MonkeyPatch, code: str, exit_code: int
) -> None:
    def refuse(*_: object) -> None:
        raise LinkError(code, "no")

    monkeypatch.setattr(process, "LogSegmenter", lambda *_: None)
    monkeypatch.setattr(process, "open_source", refuse)
    assert process.main(["--camera", "stick", "--frames", "zed"]) == exit_code
