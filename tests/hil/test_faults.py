"""Fault orders: their text, the catalogue they serve, and their effect on a running machine in lockstep."""

from __future__ import annotations

import math
from random import Random
from types import SimpleNamespace

import pytest

from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramFault, DatagramRefused
from hil.faults.catalogue import BY_NAME, CASES, Where
from hil.faults.draws import Scene
from hil.faults.injector import Injector, effect_of
from hil.faults.table import FAULTS, Edge, Order, Word, make, parse
from hil.faults.wire_faults import wire_fault
from hil.harness.operator import Operator
from hil.wire.faults import Kind
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused
from sim.plant_faults import BEGINNERS
from tests.codes import coded

PALMS, AORO = load_profile("palms_471"), load_profile("aoro_fc8")


def test_the_catalogue_has_its_45_entries_in_order_with_names_of_their_own() -> None:
    assert [case.number for case in CASES] == list(range(1, 46))
    assert len(BY_NAME) == 45
    assert all((case.draw is not None) == (case.where in (Where.RUN, Where.START)) for case in CASES)


def test_every_word_of_px4_is_used_and_every_fault_has_its_doer() -> None:
    assert {kind.word for kind in FAULTS.values()} == set(Word)
    assert {name for name, kind in FAULTS.items() if kind.edge is Edge.PLANT} == set(BEGINNERS)


@pytest.mark.parametrize("scene", [Scene(PALMS), Scene(AORO), Scene(AORO, True)], ids=["palms", "aoro", "drive"])
def test_every_draw_is_an_order_that_this_machine_understands(scene: Scene) -> None:
    for case in CASES:
        if case.draw is None:
            continue
        for seed in range(20):
            drawn = case.draw(Random(seed), scene)
            assert drawn == case.draw(Random(seed), scene), "the same seed draws the same injection"
            assert drawn.expected in ("NONE", "REFUSED", "D", "H", "R1", "R0", "X", "NODE")
            for order in drawn.orders:
                kind = FAULTS[order.fault]
                make(order.fault, part=order.part)
                if kind.edge is Edge.BUS:
                    wire_fault(order, scene.profile, 0, 1)


def test_an_order_is_read_from_its_text() -> None:
    assert parse("encoder-lift:stuck@12.3s") == Order("encoder-stuck", "lift", 12.3)
    assert parse("encoder-stuck/q2@1+500ms") == Order("encoder-stuck", "lift", 1.0, 0.5)
    order = parse("message-delayed/EncTilt@2.5s+1s=30", seed=4)
    assert (order.part, order.length_s, order.size, order.seed) == ("EncTilt", 1.0, 30.0, 4)
    assert parse("estop:off").fault == "estop-pressed" and math.isinf(parse("estop:off").length_s)
    assert parse("valve-gain").sized() == 0.5
    assert [parse(text).part for text in ("mode-switch@3+2s", "mode-switch/auto")] == ["idle", "auto"]


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("encoder lift stuck", "fault.syntax"),
        ("nothing", "fault.unknown"),
        ("encoder-lift:off", "fault.unknown-word"),
        ("encoder-stuck/wheel", "fault.part"),
        ("estop-pressed/lift", "fault.part"),
        ("encoder-stuck@1.2.3", "fault.syntax"),
        ("encoder-stuck+0s", "fault.time"),
        ("process-stuck/console", "fault.part"),
        ("mode-switch/manual", "fault.part"),
    ],
)
def test_a_wrong_order_is_refused_in_words(text: str, code: str) -> None:
    with pytest.raises(InputRefused, check=coded(code)):
        parse(text)


def test_bus_faults_name_the_bus_of_their_message() -> None:
    bus, fault = wire_fault(make("bus-drop", part="VehStat"), AORO, 5, 9)
    assert (bus, fault.kind, fault.start_ns, fault.end_ns) == ("mach0", Kind.DROP, 5, 9)
    assert wire_fault(make("bus-stub", part="crane0"), AORO, 0, 1)[1].node == "controller"
    with pytest.raises(InputRefused, check=coded("fault.no-bus")):
        wire_fault(make("bus-babble", part="mach0"), PALMS, 0, 1)
    with pytest.raises(InputRefused, check=coded("fault.no-message")):
        wire_fault(make("bus-drop", part="VehStat"), PALMS, 0, 1)


def setpoint(sequence: int = 1) -> bytes:
    knots = tuple(Knot(i * 50_000_000, (0.1,) * 5, (0.0,) * 5) for i in range(3))
    return encode(CraneSetpoint(sequence, 7, 1_000_000_000, 100_000_000, GrappleCommand.NEUTRAL, False, knots))


def test_datagrams_are_lost_late_repeated_and_stamped_wrongly() -> None:
    assert effect_of(make("planner-off"))(0, [setpoint()]) == []
    late = effect_of(make("planner-delayed", size=30.0))
    assert late(0, [setpoint()]) == [] and late(30_000_000, []) == [setpoint()]
    again = effect_of(make("planner-replay"))
    assert again(0, [setpoint(1)]) == [setpoint(1)] and again(1, [setpoint(2)]) == [setpoint(1)]
    (future,) = effect_of(make("planner-future", size=500.0))(0, [setpoint()])
    message = decode(future)
    assert isinstance(message, CraneSetpoint) and message.stamp_ns == 1_500_000_000


def test_a_number_that_is_none_arrives_with_a_right_checksum_and_damage_does_not() -> None:
    (bad,) = effect_of(make("planner-nan"))(0, [setpoint()])
    with pytest.raises(DatagramRefused) as caught:
        decode(bad)
    assert caught.value.fault is DatagramFault.NOT_FINITE
    for seed in range(50):
        (broken,) = effect_of(make("planner-garbage", seed=seed))(0, [setpoint()])
        with pytest.raises(DatagramRefused):
            decode(broken)


def test_the_link_of_an_operator_who_watches_is_cut_for_a_while() -> None:
    operator = Operator(7, lambda *_: None, watches=True)
    injector = Injector(SimpleNamespace(operator=operator))  # type: ignore[arg-type]
    injector.order(make("operator-off", length_s=1.0), 1000)
    injector.begin(999)
    assert not operator.cut
    injector.begin(1000)
    assert operator.cut
    injector.begin(1_000_001_000)
    assert not operator.cut


def test_the_link_of_an_operator_who_does_not_watch_cannot_be_cut() -> None:
    injector = Injector(SimpleNamespace(operator=Operator(7, lambda *_: None)))  # type: ignore[arg-type]
    injector.order(make("operator-off"), 1000)
    with pytest.raises(InputRefused, check=coded("fault.not-watched")):
        injector.begin(1000)
