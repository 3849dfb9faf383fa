"""Faults of the plant's parts: the frames and readings that leave it are those of the fault, and whole again after."""

from __future__ import annotations

import math
from random import Random
from types import SimpleNamespace

import pytest

from can_dbc.messages.crane import ModeSwitch
from can_dbc.protocols.e2e import Checker, Status
from machine.loading.profile_file import load_profile
from sim import faults
from sim.errors import PlantError
from sim.faults import EncoderFault, FrameTap, SpoolFaults
from sim.kinematic import KinematicMachine
from sim.plant import Plant
from sim.plant_faults import BEGINNERS, PlantFault, begin, database, message
from sim.process import live_plant
from sim.process.live_plant import LivePlant
from tests.codes import coded

MS = 1_000_000
PROFILE = load_profile("palms_471")
ESTOP = database("crane").message("EstopStat")


@pytest.fixture
def plant() -> KinematicMachine:
    return KinematicMachine(PROFILE, 0, step_ns=2_500_000)


def sent_of(plant: KinematicMachine, key: int, ms: int, start_ms: int = 0) -> list[bytes]:
    """Payloads under a key in a span of time, stepped in slices."""
    found = []
    for k in range(start_ms * 4 // 5, (start_ms + ms) * 4 // 5):
        found += [data for _, found_key, data in plant.step(1_000_000_000 + k * 1_250_000, []) if found_key == key]
    return found


def test_a_silent_message_is_not_sent_and_comes_back(plant: KinematicMachine) -> None:
    assert sent_of(plant, ESTOP.key, 50)
    end = begin(plant, PlantFault("message-off", "EstopStat"), 0)
    assert not sent_of(plant, ESTOP.key, 50, 50)
    end()
    assert sent_of(plant, ESTOP.key, 50, 100)


def test_a_repeated_message_has_a_counter_that_stands_still(plant: KinematicMachine) -> None:
    last = sent_of(plant, ESTOP.key, 40)[-1]
    begin(plant, PlantFault("message-stuck", "EstopStat"), 0)
    found = sent_of(plant, ESTOP.key, 60, 40)
    assert len(found) > 3 and set(found) == {last}


def test_a_masquerade_has_a_checksum_that_is_right_for_another_message_only(plant: KinematicMachine) -> None:
    begin(plant, PlantFault("message-masquerade", "EstopStat"), 0)
    assert ESTOP.data_ids is not None
    checker = Checker(ESTOP.data_ids)
    assert {checker.check(data) for data in sent_of(plant, ESTOP.key, 60)} == {Status.ERROR}


def test_a_broken_wire_and_a_person_are_protected_correctly(plant: KinematicMachine) -> None:
    begin(plant, PlantFault("estop-wire", seed=1), 0)
    begin(plant, PlantFault("person-in-zone"), 0)
    assert ESTOP.data_ids is not None
    checker, values = Checker(ESTOP.data_ids), {}
    for data in sent_of(plant, ESTOP.key, 60):
        assert checker.check(data) is not Status.ERROR
        values = ESTOP.named(ESTOP.receive(data))
    assert (values["ChannelA"], values["ChannelB"], values["Person"]) == (0, 1, 1)


def test_the_mode_switch_is_turned_at_once_and_back_at_the_end(plant: KinematicMachine) -> None:
    def sent(start_ms: int) -> list[float]:
        return [ESTOP.named(ESTOP.receive(d))["ModeSwitch"] for d in sent_of(plant, ESTOP.key, 20, start_ms)]

    assert set(sent(0)) == {0}
    plant.estop.turn(ModeSwitch.AUTO)
    end = begin(plant, PlantFault("mode-switch", "faulty"), 0)
    assert set(sent(20)) == {3}
    end()
    assert set(sent(40)) == {2}
    begin(plant, PlantFault("mode-switch", "not-fitted"), 0)
    assert set(sent(60)) == {0}


def test_a_delayed_message_keeps_its_payload() -> None:
    tap = FrameTap()
    end = tap.delay("crane0", 7, 20 * MS)
    assert tap.pass_on(0, [("crane0", 7, b"a"), ("crane0", 8, b"b")]) == [("crane0", 8, b"b")]
    end()
    assert tap.pass_on(10 * MS, []) == []
    assert tap.pass_on(20 * MS, []) == [("crane0", 7, b"a")]


def test_intermittent_and_slow_lose_frames_reproducibly() -> None:
    def lost(effect: faults.Effect) -> str:
        return "".join("." if effect(b"x", 0) is None else "x" for _ in range(40))

    assert lost(faults.every(4)) == "...x" * 10
    one, again = (lost(faults.intermittent(Random(3), 0.5)) for _ in range(2))
    assert one == again and 5 < one.count(".") < 35


def test_encoder_faults_change_the_reading_as_they_say(plant: KinematicMachine) -> None:
    plant.step(1_000_000_000, [])
    lift = plant.encoders["lift"]
    true = lift.measure(1_000_000_000)
    for name, size, expected in (
        ("encoder-jump", 0.2, true + 0.2),
        ("encoder-drift", 0.01, true + 0.02),
        ("encoder-scale", -1.0, true),
    ):
        end = begin(plant, PlantFault(name, "lift", size), 1_000_000_000)
        assert lift.measure(3_000_000_000) == pytest.approx(expected, abs=2e-3), name
        end()
    assert lift.measure(4_000_000_000) == pytest.approx(true, abs=2e-3)


def test_a_reversed_encoder_turns_about_where_it_was() -> None:
    fault = EncoderFault(scale=-1.0, pivot=0.5)
    assert fault.position(0.7, 0) == pytest.approx(0.3)


def test_a_frozen_encoder_repeats_its_position(plant: KinematicMachine) -> None:
    plant.step(1_000_000_000, [])
    slew = plant.encoders["slew"]
    before = slew.measure(1_000_000_000)
    begin(plant, PlantFault("encoder-stuck", "slew"), 1_000_000_000)
    slew.observe(2_000_000_000, before + 0.3, 0.1)
    assert slew.measure(2_000_000_000) == before


def test_spools_stick_drift_and_weaken_by_name() -> None:
    faults = SpoolFaults()
    assert not faults
    faults.stuck["lift"], faults.bias["tilt"], faults.gain["ext"] = 0.7, 0.2, 0.5
    assert faults and faults.apply(("slew", "lift", "tilt", "ext"), (0.1, 0.0, 0.1, -0.4)) == pytest.approx(
        [0.1, 0.7, 0.3, -0.2]
    )


def test_a_valve_node_boots_again(plant: KinematicMachine) -> None:
    sent_of(plant, 0x710, 20)
    begin(plant, PlantFault("node-reset", "valves"), 0)
    assert b"\x00" in sent_of(plant, 0x710, 20, 20)


def test_what_a_machine_does_not_have_is_refused_in_words(plant: KinematicMachine) -> None:
    for fault, code in (
        (PlantFault("no-such"), "fault.unknown"),
        (PlantFault("encoder-stuck", "articulation"), "fault.no-encoder"),
        (PlantFault("gnss-off"), "fault.no-gnss"),
        (PlantFault("hose-burst", "lift"), "fault.no-physics"),
        (PlantFault("message-off", "VehStat"), "fault.no-message"),
        (PlantFault("mode-switch", "manual"), "fault.no-position"),
        (PlantFault("message-masquerade", "EncLift"), "fault.no-data-id"),
    ):
        with pytest.raises(PlantError, check=coded(code)):
            begin(plant, fault, 0)


def test_every_fault_begins_and_ends_on_a_machine_that_drives() -> None:
    plant = KinematicMachine(load_profile("aoro_fc8"), 0, step_ns=2_500_000)
    plant.step(1_000_000_000, [])
    parts = {"encoder": "lift", "message": "VehStat", "valve": "lift", "node": "valves", "mode": "idle"}
    for name in BEGINNERS:
        if name in ("hose-burst", "load-overload"):
            continue  # need physics
        begin(plant, PlantFault(name, parts.get(name.partition("-")[0], ""), 2.0, 1), 1_000_000_000)()
    assert message(plant.profile, "VesselHeading")[0] == "mach0"
    assert math.isfinite(plant.encoders["lift"].measure(1_000_000_000))


def test_a_live_plant_begins_a_fault_on_request_and_ends_it_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = Plant(PROFILE, scene=())
    now_ns = 5_000 * MS
    monkeypatch.setattr(live_plant, "time", SimpleNamespace(monotonic_ns=lambda: now_ns))
    try:
        live = LivePlant(plant, {}, None)
        assert live._reply({"op": "fault", "name": "encoder-stuck", "part": "lift", "for_s": "0.5"}) == {"ok": True}
        assert plant.encoders["lift"].fault is not None
        live._on_step(now_ns + 499 * MS)
        assert plant.encoders["lift"].fault is not None, "not before its time"
        live._on_step(now_ns + 501 * MS)
        assert plant.encoders["lift"].fault is None
        with pytest.raises(PlantError, check=coded("fault.not-a-number")):
            live._reply({"op": "fault", "name": "encoder-jump", "part": "lift", "size": "much"})
    finally:
        plant.close()


def test_a_stuck_spool_moves_its_joint_only_with_pilot_pressure(
    plant: KinematicMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.step(1_000_000_000, [])
    begin(plant, PlantFault("valve-stuck", "lift", 0.8), 1_000_000_000)
    monkeypatch.setattr(type(plant.estop), "pilot_on", False)
    assert plant._spools(1_000_000_000)[1] == 0.0
    monkeypatch.setattr(type(plant.estop), "pilot_on", True)
    assert plant._spools(1_000_000_000)[1] == 0.8


def test_a_burst_hose_lets_the_boom_fall() -> None:
    plant = Plant(PROFILE, scene=())
    try:
        neutral = [0.0] * len(plant.world.functions)
        before = plant.world.tip()[2]
        begin(plant, PlantFault("hose-burst", "lift"), 0)
        for _ in range(200):
            plant.world.step(neutral)
        assert plant.world.tip()[2] < before - 0.1
    finally:
        plant.close()
