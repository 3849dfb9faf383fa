"""Every kind of fault, its window and selection, and its reproducibility."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.bus.base import BusState
from can_dbc.frame import ERROR, Frame
from hil.faults.table import parse
from hil.faults.wire_faults import wire_fault
from hil.wire.core import Node, WireCore
from hil.wire.faults import Fault, Kind
from machine.loading.profile_file import load_profile

MS = 1_000_000


def traffic(core: WireCore, sender: Node, until_ns: int, keys: tuple[int, ...] = (0x100, 0x200)) -> None:
    """The sender offers each key once per ms."""
    while core.now_ns < until_ns:
        for key in keys:
            core.submit(sender, key, (core.now_ns // MS).to_bytes(8, "big"))
        core.advance(core.now_ns + MS)


def setup(*faults: Fault) -> tuple[WireCore, Node, Node]:
    core = WireCore(1_000_000)
    for fault in faults:
        core.inject(fault)
    return core, core.attach("a"), core.attach("b")


def data_frames(node: Node) -> list[Frame]:
    return [frame for frame in node.take() if not frame.key & ERROR]


def test_drop_hits_its_key_in_its_window() -> None:
    core, a, b = setup(Fault(Kind.DROP, 3 * MS, 6 * MS, key=0x100, mask=0x7FF))
    traffic(core, a, 10 * MS)
    frames = data_frames(b)
    assert [frame.data[7] for frame in frames if frame.key == 0x100] == [0, 1, 2, 6, 7, 8, 9]
    assert [frame.data[7] for frame in frames if frame.key == 0x200] == list(range(10))
    assert (a.done, a.tec) == (20, 0)  # the sender has not noticed


def test_a_fault_meant_for_one_frame_hits_the_first_in_its_window() -> None:
    core, a, b = setup(Fault(Kind.DROP, 3 * MS, 6 * MS, key=0x100, mask=0x7FF, most=1))
    traffic(core, a, 10 * MS)
    frames = data_frames(b)
    assert [frame.data[7] for frame in frames if frame.key == 0x100] == [0, 1, 2, 4, 5, 6, 7, 8, 9]


def test_a_window_shorter_than_the_period_is_meant_for_one_frame() -> None:
    profile = load_profile("palms_471")
    for length_ns, most in ((4_500_000, 1), (300 * MS, 0)):
        order = parse(f"bus-corrupt/ValveFbA+{length_ns / MS}ms")
        assert wire_fault(order, profile, 0, length_ns)[1].most == most


def test_delay_and_repeat_shift_the_reception_and_its_stamp() -> None:
    plain, a, b = setup()
    traffic(plain, a, MS, (0x100,))
    stamp_ns = data_frames(b)[0].stamp_ns
    core, a, b = setup(Fault(Kind.DELAY, shift_ns=7 * MS), Fault(Kind.REPEAT, shift_ns=2 * MS, count=2))
    traffic(core, a, MS, (0x100,))
    core.advance(stamp_ns + 7 * MS - 1)
    assert b.rx == []
    core.advance(20 * MS)
    assert [frame.stamp_ns - stamp_ns for frame in b.take()] == [7 * MS, 9 * MS, 11 * MS]


def test_stamps_never_decrease_even_when_frames_are_delayed() -> None:
    core, a, b = setup(Fault(Kind.DELAY, key=0x100, mask=0x7FF, shift_ns=1_234_567))
    traffic(core, a, 20 * MS)
    stamps = [frame.stamp_ns for frame in b.take()]
    assert len(stamps) > 30 and stamps == sorted(stamps)


def test_corrupt_flips_the_given_number_of_bits_undetected() -> None:
    core, a, b = setup(Fault(Kind.CORRUPT, count=3, key=0x100, mask=0x7FF))
    traffic(core, a, 50 * MS)
    for frame in data_frames(b):
        wrong = int.from_bytes(frame.data, "big") ^ (frame.stamp_ns // MS)
        assert wrong.bit_count() == (3 if frame.key == 0x100 else 0)
    assert a.tec == b.rec == core.errors == 0


def test_corrupting_an_empty_frame_changes_nothing() -> None:
    core, a, b = setup(Fault(Kind.CORRUPT, count=3))
    core.submit(a, 0x100, b"")
    core.advance(MS)
    assert b.take()[0].data == b""


def test_errors_on_one_node_drive_it_off_within_milliseconds() -> None:
    core, a, b = setup(Fault(Kind.ERROR, 5 * MS, node="a"))
    traffic(core, a, 20 * MS, (0x100,))
    assert a.state is BusState.OFF and b.state is not BusState.OFF
    assert [frame.data[7] for frame in data_frames(b)] == list(range(5))
    assert core.errors == 32


def test_a_fault_hits_with_its_probability_reproducibly() -> None:
    def survivors(seed: int) -> list[int]:
        core, a, b = setup(Fault(Kind.DROP, probability=0.3, seed=seed))
        traffic(core, a, 1000 * MS, (0x100,))
        return [int.from_bytes(frame.data, "big") for frame in data_frames(b)]

    assert survivors(1) == survivors(1) != survivors(2)
    assert 640 < len(survivors(1)) < 760


def test_a_babbling_node_takes_the_whole_bus_and_then_stops() -> None:
    core, a, b = setup(Fault(Kind.BABBLE, 5 * MS, 10 * MS, key=0x000))
    traffic(core, a, 20 * MS, (0x100,))
    received = data_frames(b)
    own = [frame.data[7] for frame in received if frame.key == 0x100]
    babble = [frame.stamp_ns for frame in received if frame.key == 0x000]
    assert own[:5] == list(range(5)) and min(babble) > 5 * MS and max(babble) <= 10 * MS
    assert not any(5 * MS + MS // 2 < frame.stamp_ns < 10 * MS for frame in received if frame.key == 0x100)
    assert len({right - left for left, right in pairwise(babble)}) == 1
    assert own[-1] == 19 and len(core.nodes) == 2


def test_a_babbling_node_can_have_a_period() -> None:
    core, _, b = setup(Fault(Kind.BABBLE, 0, 10 * MS, key=0x7FF, shift_ns=MS, node="noise", data=b"\1"))
    core.advance(10 * MS)
    assert 8 <= len(data_frames(b)) <= 10


def test_a_cut_node_is_isolated_and_reconnects() -> None:
    core, a, b = setup(Fault(Kind.CUT, 5 * MS, 30 * MS, node="a"))
    c = core.attach("c")
    traffic(core, a, 20 * MS, (0x100,))
    core.submit(b, 0x200, b"")
    core.advance(25 * MS)
    assert (a.state, a.tec) == (BusState.PASSIVE, 128) and len(a.queue) == 10
    assert data_frames(a) == [] and len(data_frames(c)) == 6  # the others still talk
    core.advance(40 * MS)
    assert len(a.queue) == 0 and a.tec == 128 - 10
    assert all(frame.stamp_ns > 30 * MS for frame in data_frames(b)[5:])


def test_a_cut_bus_isolates_every_node_including_later_ones() -> None:
    core, a, b = setup(Fault(Kind.CUT, 5 * MS))
    traffic(core, a, 20 * MS, (0x100,))
    c = core.attach("c")
    core.submit(b, 0x200, b"")
    core.advance(40 * MS)
    assert a.state is b.state is BusState.PASSIVE
    assert len(data_frames(b)) == 5 and c.rx == []


def test_a_cut_does_not_change_the_past() -> None:
    """A frame that waited behind a babbling node is tried only after the cut, on a cable of its own."""
    core, a, b = setup(Fault(Kind.BABBLE, end_ns=10 * MS, key=0), Fault(Kind.CUT, 5 * MS, node="a"))
    core.submit(a, 0x700, b"")
    core.advance(10 * MS)
    assert min(frame.stamp_ns for frame in a.rx if frame.key & ERROR) > 5 * MS
    assert core.busy_ns <= 10 * MS + 65_000 and b.rx


def test_a_cut_and_its_end_do_not_restart_a_bus_off_node() -> None:
    core = WireCore(1_000_000, restart_ns=0)
    a, b = core.attach("a"), core.attach("b")
    core.inject(Fault(Kind.ERROR, end_ns=10 * MS))
    core.inject(Fault(Kind.CUT, 20 * MS, 30 * MS))
    core.submit(a, 0x100, b"")
    core.advance(40 * MS)
    assert a.state is BusState.OFF
    a.take()
    core.attach("c")
    core.submit(b, 0x200, b"")
    core.advance(50 * MS)
    assert a.rx == [] and b.done == 1


def test_healing_removes_every_fault() -> None:
    core, a, b = setup(
        Fault(Kind.DROP, key=0x100, mask=0x7FF),
        Fault(Kind.CUT, node="b"),
        Fault(Kind.CUT, 15 * MS),
        Fault(Kind.BABBLE, key=0),
        Fault(Kind.BABBLE, 15 * MS, key=0),
    )
    core.advance(5 * MS)
    core.heal()
    b.take()
    traffic(core, a, 20 * MS, (0x100,))
    assert [frame.data[7] for frame in b.take()] == list(range(5, 20))
    assert len(core.nodes) == 2


@given(
    st.builds(
        Fault,
        kind=st.sampled_from(Kind),
        start_ns=st.integers(0, 10**12),
        end_ns=st.integers(10**12 + 1, 10**13),
        node=st.none() | st.text(max_size=5),
        data=st.binary(max_size=8),
        probability=st.floats(0, 1),
    )
)
def test_a_fault_survives_json(fault: Fault) -> None:
    assert Fault.from_json(json.loads(json.dumps(fault.to_json()))) == fault


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"kind": "melt"},
        {"kind": "drop", "colour": 1},
        {"kind": "drop", "start_ns": 5, "end_ns": 5},
        {"kind": "delay", "shift_ns": -1},
        {"kind": "repeat", "count": 0},
        {"kind": "drop", "most": -1},
        {"kind": "babble", "data": "00" * 9},
    ],
)
def test_a_malformed_fault_is_refused(fields: dict[str, object]) -> None:
    with pytest.raises((ValueError, TypeError)):
        Fault.from_json(fields)
