"""Opening a bus, choosing an address, error frames, and a kernel queue without room."""

from __future__ import annotations

import subprocess
import sys
import time

from can_dbc.bus import factory as factory
from can_dbc.bus.base import (
    BaseBus,
)
from can_dbc.frame import Frame


def test_the_guard_can_open_wire_and_socketcan_with_the_standard_library_only() -> None:
    code = (
        "import sys; import can_dbc.bus.base, can_dbc.bus.socketcan, can_dbc.bus.wire_client;"
        "own = {'can_dbc'}; names = {name.partition('.')[0] for name in sys.modules};"
        "print(sorted(n for n in names - own - sys.stdlib_module_names if n in ('can', 'msgspec', 'numpy')))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


class Waiting(BaseBus):
    """A bus with groups of waiting frames, one for each drain."""

    def __init__(self) -> None:
        super().__init__("test")
        self.bunches: list[list[Frame]] = []

    def _receive(self, frames: list[Frame]) -> None:
        if self.bunches:
            frames += self.bunches.pop(0)


def test_after_a_flush_an_older_frame_is_recognized_by_its_stamp() -> None:
    """The wire's daemon may delay frames for a moment, and a flooded socket holds more than one flush reads."""
    bus = Waiting()
    before_ns = time.monotonic_ns()
    bus.flush()
    new = Frame(time.monotonic_ns(), 9, b"new")
    bus.bunches = [[Frame(before_ns, 1, b"old")], [Frame(before_ns, 2, b"old"), new], [Frame(before_ns, 3, b"late")]]
    kept = [Frame(before_ns, 0, b"kept")]
    assert [bus.drain(kept), bus.drain(kept), bus.drain(kept)] == [0, 1, 1]
    assert [frame.data for frame in kept] == [b"kept", b"new", b"late"]  # once one is newer, all are
