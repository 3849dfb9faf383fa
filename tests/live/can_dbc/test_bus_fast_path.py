"""The receive code of SocketCAN on an AF_UNIX pair that carries the same struct can_frame: runs on every kernel."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from can_dbc.bus.factory import open_bus
from can_dbc.bus.receive_clock import DRIFT_PPM
from can_dbc.frame import EXTENDED, REMOTE, Frame
from tests.can_dbc.test_bus_fast_path import Pair, control_data, deliver


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.link.close()
    pair.far.close()


def test_frames_keep_key_payload_order_and_time(pair: Pair) -> None:
    sent = [(0x181, b"12345678"), (0x1FFF_FFFF | EXTENDED, b""), (0x7FF | REMOTE, bytes(3)), (0, b"\xff")]
    before_ns = time.monotonic_ns()
    for key, data in sent:
        pair.put(key, data)
    between_ns = time.monotonic_ns()
    frames = pair.take()
    assert [(frame.key, frame.data) for frame in frames] == sent
    assert all(type(frame) is Frame and type(frame.data) is bytes for frame in frames)
    stamps = [frame.stamp_ns for frame in frames]
    assert stamps == sorted(stamps)
    slack_ns = 1_000_000  # two clocks are read one after the other, and somebody may take the processor in between
    assert before_ns - slack_ns <= stamps[0] and stamps[-1] <= between_ns + slack_ns


@pytest.mark.parametrize("hardware_ns", [None, 5_000_000_000])
def test_lost_frames_are_counted_over_the_wrap(
    hardware_ns: int | None, pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_ns = time.time_ns()
    for counted, lost in ((None, 0), (7, 7), (7, 7), (0xFFFF_FFF0, 0xFFFF_FFF0), (4, 0x1_0000_0004)):
        first, last = control_data(now_ns, hardware_ns, None), control_data(now_ns, hardware_ns, counted)
        assert len(deliver(pair, monkeypatch, [first, last])) == 2
        assert pair.link.dropped == lost


def test_stamps_of_an_adapter_are_used(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames a millisecond apart on the bus; the interrupt of the second came 300 us late."""
    time.sleep(0.011)  # a socket has no frames that are older than itself
    now_ns = time.time_ns() - 10_000_000
    controls = [control_data(now_ns, 77_000_000_000), control_data(now_ns + 1_300_000, 77_001_000_000)]
    first, second = deliver(pair, monkeypatch, controls)
    assert second.stamp_ns - first.stamp_ns == pytest.approx(1_000_000, abs=1_000_000 * DRIFT_PPM // 1_000_000)


HOUR_NS = 3_600 * 10**9


@pytest.mark.parametrize("adapter", [False, True])
@pytest.mark.parametrize("step_ns", [-HOUR_NS * 10**5, -HOUR_NS, -(10**8), 10**8, HOUR_NS, HOUR_NS * 10**5])
def test_setting_the_wall_clock_changes_no_receive_time(
    pair: Pair, monkeypatch: pytest.MonkeyPatch, step_ns: int, adapter: bool
) -> None:
    """Two frames wait while the clock is set, between them; the larger steps exceed the time since boot."""
    hardware_ns = 77 * 10**9 if adapter else None
    deliver(pair, monkeypatch, [control_data(time.time_ns(), hardware_ns)])
    arrived_ns, wall_ns = time.monotonic_ns(), time.time_ns()
    time.sleep(0.002)
    monkeypatch.setattr(time, "time_ns", lambda: time.monotonic_ns() - arrived_ns + wall_ns + step_ns)
    later = None if hardware_ns is None else hardware_ns + 2_000_000
    before, after = deliver(
        pair, monkeypatch, [control_data(wall_ns, hardware_ns), control_data(wall_ns + step_ns + 1_000_000, later)]
    )
    slack_ns = 200_000 if not adapter else 2_000_000
    assert before.stamp_ns == pytest.approx(arrived_ns, abs=slack_ns)
    assert after.stamp_ns == pytest.approx(arrived_ns + 1_000_000, abs=slack_ns)
    (next_one,) = deliver(pair, monkeypatch, [control_data(time.time_ns())])
    assert time.monotonic_ns() - next_one.stamp_ns < 2_000_000


def test_an_adapter_of_python_can_is_stamped_within_its_drain(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_bus("virtual:steps") as bus, open_bus("virtual:steps") as other:
        for step_ns in (HOUR_NS, -HOUR_NS, 500_000_000, -500_000_000):
            real = time.time_ns
            before_ns = time.monotonic_ns()
            other.send(0x181, bytes(8))
            monkeypatch.setattr(time, "time_ns", lambda real=real, step_ns=step_ns: real() + step_ns)
            frames: list[Frame] = []
            bus.drain(frames)
            (frame,) = frames
            assert before_ns - 50_000_000 <= frame.stamp_ns <= time.monotonic_ns()
            frames.clear()
            bus.drain(frames)
