"""Opening a bus with the standard library only, and a flush."""

from __future__ import annotations

import subprocess
import sys
import time

from can_dbc.frame import Frame
from tests.can_dbc.test_bus import Waiting


def test_the_guard_can_open_wire_and_socketcan_with_the_standard_library_only() -> None:
    code = (
        "import sys; import can_dbc.bus.base, can_dbc.bus.socketcan, can_dbc.bus.wire_client;"
        "own = {'can_dbc'}; names = {name.partition('.')[0] for name in sys.modules};"
        "print(sorted(n for n in names - own - sys.stdlib_module_names if n in ('can', 'msgspec', 'numpy')))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


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
