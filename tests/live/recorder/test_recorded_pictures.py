"""The recorder asks the log detector for its pictures and records each of them once; without a detector it goes on."""

from __future__ import annotations

import threading
import time

from can_dbc.messages.picture import PictureFacts, encode_picture
from recorder.__main__ import InputCollector, udp_socket
from tests.console.played_detector import detector
from tests.operator_end import udp_end

JPEG = b"\xff\xd8\xff" + bytes(99)


class NoTicks:
    lost = 0

    def read(self) -> list[bytes]:
        return []


def collected(address: tuple[str, int], seconds: float) -> list[bytes]:
    """The pictures that arrive in a while."""
    with udp_socket(0) as reports:
        inputs = InputCollector({}, NoTicks(), reports, None, address)  # type: ignore[arg-type]
        thread = threading.Thread(target=inputs.run)
        thread.start()
        time.sleep(seconds)
        inputs.end()
        thread.join()
    found = []
    while (item := inputs.items.get(timeout=1)) is not None:
        assert item[0] == "picture" and isinstance(item[2], bytes)
        found.append(item[2])
    return found


def test_a_picture_is_recorded_once_and_asked_for_once_a_second() -> None:
    picture = encode_picture(PictureFacts(1, "stick", 7, "", 4, 4), JPEG)
    with detector(picture) as (address, asked):
        assert collected(address, 2.5) == [picture]
        assert asked[0] == 0 and set(asked[1:]) == {7} and len(asked) <= 4


def test_a_detector_that_is_not_there_or_has_no_camera_costs_nothing() -> None:
    with udp_end(None) as gone:
        address = gone.getsockname()
    assert collected(address, 1.5) == []
    with detector(b'{"error":"unknown op"}') as (address, _):
        assert collected(address, 1.5) == []
