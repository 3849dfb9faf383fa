"""The fault campaign: its verdicts, its metrics, and a machine that is forked at a moment and continues the same."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from controller.config import load as load_settings
from controller.transitions import OPERATING
from experiments.common.pool import Job
from experiments.faults import nominal
from experiments.faults.evidence import Evidence
from experiments.faults.experiment import nominal_plan, plan, scenes_of
from experiments.faults.metrics import METRICS, gather, is_blind
from experiments.faults.running import HeldSwing, Swing, build, warm
from experiments.faults.separation import Separation, merged
from experiments.faults.trial import in_child, inject
from hil.faults.catalogue import BY_NAME, CASES
from hil.faults.table import parse
from hil.harness.lockstep import START_NS
from machine.loading.profile_file import load_profile
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused
from tests.codes import coded
from tests.experiments.fault_outcomes import outcome


@pytest.mark.parametrize(
    ("changed", "verdict", "detect_ms"),
    [
        ({}, "ok", 15.0),
        ({"reached": {"R1": 26.0}}, "late", 26.0),
        ({"reached": {"R0": 26.0, "D": 3.0}, "expected": "H"}, "late", 26.0),
        ({"reached": {"D": 3.0}}, "weak", 3.0),
        ({"reached": {}}, "undetected", None),
        ({"reached": {"R0": 2.0}, "tip_limit_m": 0.01}, "far", 2.0),
        ({"reached": {"R1": 260.0}, "due_ms": 236.0}, "ok", 260.0),
        ({"reached": {"R1": 262.0}, "due_ms": 236.0}, "late", 262.0),
        ({"reached": {"R1": 900.0}, "due_ms": None}, "ok", 900.0),
        ({"reached": {}, "due_ms": None}, "undetected", None),
        ({"expected": "NONE"}, "tripped", 15.0),
        ({"expected": "NONE", "reached": {"D": 1.0}}, "ok", None),
        ({"expected": "REFUSED", "reached": {}, "refused_ms": 10.0}, "ok", 10.0),
        ({"expected": "REFUSED", "reached": {}}, "undetected", None),
        ({"expected": "REFUSED", "refused_ms": 10.0}, "tripped", 10.0),
        ({"expected": "NODE", "reached": {}, "bound_ms": 200.0}, "ok", 70.0),
        ({"expected": "X", "reached": {"X": 1.0}}, "ok", 1.0),
    ],
)
def test_a_verdict_is_the_promise_kept_or_how_it_was_broken(
    changed: dict[str, Any], verdict: str, detect_ms: float | None
) -> None:
    found = outcome(**changed)
    assert (found["verdict"], found["detect_ms"], found["missed"]) == (verdict, detect_ms, verdict != "ok")


def test_a_missed_injection_is_counted_and_a_blind_spot_is_told_apart() -> None:
    rows = [outcome(), outcome(reached={}, neutral_ms=None, valves_ms=None, travel_m=0.4, astray_m=0.4)]
    everything = {c.name: {"case": c.number, "scene": "crane", "outcomes": rows} for c in CASES if c.draw}
    everything["n"] = {"scene": "x", "seconds": 7200.0, "trips": [(1.0, "why")]}
    metrics = gather(everything)
    assert {m.name for m in METRICS} <= metrics.keys()
    with_draw = sum(c.draw is not None for c in CASES)
    assert metrics["injections"] == 2 * with_draw and metrics["missed"] == with_draw
    # 0.4 m are more than a drift or a scale explains.
    assert (metrics["blind_missed"], metrics["unexplained"]) == (0, with_draw)
    assert math.isinf(metrics["neutral_max_ms"]), "valves that never became neutral"
    assert (metrics["nominal_hours"], metrics["false_trips"]) == (2.0, 1.0)
    assert metrics["c06_harm_m"] == 0.4 and metrics["c06_max_ms"] == 15.0
    far, near = {"travel_m": 0.9, "astray_m": 0.4}, {"travel_m": 0.9, "astray_m": 0.1}
    crane, behind_plc = {"scene": "crane palms_471 physics"}, {"scene": "plc valves palms_471"}
    assert is_blind(BY_NAME["valve-stuck-open"], behind_plc | far | {"verdict": "weak"})
    assert is_blind(BY_NAME["valve-stuck-open"], crane | far | {"verdict": "far"})
    assert not is_blind(BY_NAME["valve-stuck-open"], crane | near | {"verdict": "undetected"})
    assert is_blind(BY_NAME["encoder-scale"], crane | near | {"verdict": "undetected"})
    assert not is_blind(BY_NAME["encoder-scale"], crane | far | {"verdict": "undetected"}), "more harm than it explains"


def test_a_miss_is_a_named_blind_spot_only_in_the_works_that_the_catalogue_names() -> None:
    case = BY_NAME["encoder-drift"]
    missed = outcome(reached={}, expected="D", travel_m=0.3, astray_m=0.08)
    for scene, blind in (("crane palms_471 physics", 1.0), ("hold palms_471 physics", 0.0)):
        metrics = gather({scene: {"case": case.number, "scene": scene, "outcomes": [missed, outcome()]}})
        assert (metrics["c03_missed"], metrics["c03_blind_missed"], metrics["blind_missed"]) == (1.0, blind, blind)
        assert metrics["unexplained"] == 1.0 - blind
    assert all(case.blind for case in CASES if case.blind_in)


def test_work_without_faults_tells_how_near_each_monitor_came_and_where() -> None:
    def work(seed: int, most: float, bins: list[int]) -> dict[str, Any]:
        shares = {"a": {"bins": bins, "most": most, "where": "lift", "at_s": 12.0}}
        return {"scene": "crane", "seed": seed, "seconds": 3600.0, "working_s": 1.0, "trips": [], "shares": shares}

    runs = [work(1, 0.4, [3000, 500, 0, 0, 0, 0, 0]), work(2, 0.95, [1000, 2000, 30, 4, 3, 2, 1])]
    total = merged(runs)["a"]
    assert total["bins"] == [4000, 2500, 30, 4, 3, 2, 1]
    assert (total["most"], total["run"]) == (0.95, "crane, seed 2, after 12 s")


def test_an_armed_machine_tells_the_shares_of_its_monitors_and_a_disarmed_one_none() -> None:
    machine = build("drive aoro_fc8")
    controller = machine.system.controller
    separation = Separation(controller, machine.system.guard, START_NS)
    machine.system.observer.on_outputs.append(separation.outputs)
    while controller.supervisor.mode not in OPERATING:
        assert not separation.shares
        machine.system.advance()
    for _ in range(2400):
        machine.system.advance()
    assert {"carrier too fast", "guard: joint too fast", "joint stuck", "spool open"} <= separation.shares.keys()
    assert all(sum(one["bins"]) >= 3 and one["most"] < 1.0 for one in separation.shares.values())


@pytest.mark.parametrize(("scene", "text"), [("individual", None), ("calibrated", "its own profile")])
def test_a_mission_counts_as_work_with_what_it_believes_and_what_lies_in_the_bunk(
    scene: str, text: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = build("drive aoro_fc8")
    driven: list[Job] = []

    def run_mission(job: Job, mission: object, site: object, attach: Any) -> dict[str, Any]:
        driven.append(job)
        attach(machine.system)
        for _ in range(800):
            machine.system.advance()
        return {"finished": True, "failure": "", "loaded": 2, "stops": 0, "given_up": {}, "logs": [{"in_bunk": True}]}

    monkeypatch.setattr(nominal, "run_mission", run_mission)
    monkeypatch.setattr(nominal, "calibrated", lambda job: {"profile": "its own profile", "failure": None})
    told = nominal.perform(Job("m", "nominal", 3, {"scene": f"mission aoro_fc8 {scene}", "seconds": 1.0}))
    assert (told["loaded"], told["in_bunk"], told["trips"]) == (2, 1, []) and told["seconds"] == pytest.approx(1.0)
    assert driven[0].options.get("text") == text and driven[0].options["eyes"] == "ours"
    monkeypatch.setattr(nominal, "calibrated", lambda job: {"profile": None, "failure": "a stuck valve"})
    if text:
        failed = nominal.perform(Job("m", "nominal", 3, {"scene": f"mission aoro_fc8 {scene}", "seconds": 1.0}))
        assert "trips" not in failed and "a stuck valve" in str(failed)


def test_a_held_swing_ends_at_rest_without_a_step() -> None:
    profile = load_settings("palms_471").profile
    motion = HeldSwing(Swing(profile, (0.0, 0.5, -1.2, 0.6, 0.0)))
    step_s = 0.001
    for k in range(1, 8000):
        (q0, v0), (q1, v1) = motion.at((k - 1) * step_s), motion.at(k * step_s)
        for a, b, va, vb in zip(q0, q1, v0, v1, strict=True):
            assert b - a == pytest.approx(0.5 * (va + vb) * step_s, abs=1e-7)
    assert motion.at(5.5) == motion.at(1000.0) and not any(motion.at(5.5)[1])
    assert any(motion.at(4.0)[1])


@pytest.mark.parametrize("scene", ["crane palms_471", "crane aoro_fc8", "drive aoro_fc8"])
def test_work_without_faults_does_not_stop(scene: str) -> None:
    done = nominal.perform(Job("nominal", "nominal", 3, {"scene": scene, "seconds": 10.0}))
    assert done["trips"] == []
    assert done["working_s"] > 8.0, "armed within two seconds, and never refused since"


def test_the_plan_spreads_the_trials_over_the_scenes_and_leaves_none_out() -> None:
    jobs = plan(1, 100)
    counts: dict[int, int] = {}
    for job in jobs:
        counts[job.options["case"]] = counts.get(job.options["case"], 0) + job.options["count"]
    assert counts == {c.number: 100 for c in CASES}
    assert len({job.name for job in jobs}) == len(jobs)
    assert len(scenes_of(BY_NAME["message-off"])) == 5
    assert sum(j.options["seconds"] for j in nominal_plan(1, 36_000.0)) == pytest.approx(36_000.0)


@pytest.mark.long
def test_an_injection_in_a_forked_child_is_that_of_a_fresh_machine_and_of_its_repetition() -> None:
    def machine() -> Any:
        made = build("crane palms_471")
        made.until_moving()
        made.operator.hands_off = True
        return made

    number, seed = BY_NAME["message-off"].number, "a seed"
    warm = machine()
    first = in_child(lambda: inject(warm, number, seed))
    again = in_child(lambda: inject(warm, number, seed))
    fresh = inject(machine(), number, seed)
    assert first == again
    assert first["timeline"] == [list(row) for row in fresh["timeline"]]
    assert {k: v for k, v in first.items() if k != "timeline"} == {k: v for k, v in fresh.items() if k != "timeline"}
    assert first["verdict"] == "ok" and first["neutral_ms"] <= 100.0


@pytest.mark.long
def test_burst_and_overload_of_a_machine_with_physics_are_answered_in_time() -> None:
    machine = warm("crane palms_471 physics")
    burst = in_child(lambda: inject(machine, BY_NAME["hose-burst"].number, "a seed"))
    assert (burst["verdict"], burst["reason"], burst["due_ms"]) == ("ok", "HOSE_BURST", 0.0)
    assert "R0" in burst["reached"]
    load = in_child(lambda: inject(machine, BY_NAME["overload"].number, "a seed"))
    yielding = ("OVERLOAD", "OVERLOADED", "JOINT_RUNAWAY", "JOINT_REVERSED")  # the last one while it rises
    assert load["verdict"] == "ok" and load["reason"] in yielding
    assert 150.0 < load["due_ms"] < 300.0 and load["detect_ms"] < load["due_ms"]


@pytest.mark.long
def test_a_fault_at_every_edge_is_answered_and_named() -> None:
    for scene, text, reaction, reason in (
        ("crane palms_471", "estop-pressed", "R0", "ESTOP_PRESSED"),
        ("crane palms_471", "bus-stub/crane0", "R0", "BUS_PASSIVE"),  # all inputs are lost at once
        ("crane palms_471", "process-off/planner", "H", "LEASE_LOST"),
        ("crane palms_471", "process-off/guard", "R0", "GUARD_LOST"),
        ("crane palms_471", "process-stuck/controller+30ms", "R0", "COMPUTER_STALLED"),  # no SYNC meanwhile
        ("crane palms_471", "planner-nan", "H", "SETPOINTS_REFUSED"),
        ("drive aoro_fc8", "message-off/VehStat", "R0", "CARRIER_LOST"),
        ("drive aoro_fc8", "gnss-off", "H", "HEADING_LOST"),
        ("plc valves palms_471", "plc-off", "R0", "ESTOP_LOST"),  # its frame comes through the PLC
    ):
        found = in_child(lambda scene=scene, text=text: _injected(scene, text))  # type: ignore[misc]
        assert reaction in found["reached"], (scene, text, found)
        assert found["reason"] == reason, (scene, text, found)
    with pytest.raises(InputRefused, check=coded("fault.no-plc")):
        _injected("crane palms_471", "plc-off")


def _injected(scene: str, text: str) -> dict[str, Any]:
    machine = warm(scene)
    at_ns = machine.system.now_ns
    machine.injector.order(parse(text), at_ns)
    machine.evidence.begin(at_ns, machine.scene.drives)
    while machine.system.now_ns < at_ns + 900_000_000:
        machine.advance()
    return {"reached": machine.evidence.reached, "reason": machine.evidence.reason}


def test_a_stop_that_becomes_harder_for_another_reason_is_seen() -> None:
    def watched(*seen: tuple[Mode, Reason]) -> Evidence:
        evidence = Evidence([], load_profile("palms_471"))
        evidence.begin(0, drives=False)
        for k, (mode, reason) in enumerate(seen):
            outputs: Any = SimpleNamespace(mode=mode, reason=reason, detail=0)
            evidence.outputs(outputs, k * 1_000_000)
        return evidence

    ramp = [(Mode.ACTIVE, Reason.NONE), (Mode.STOP, Reason.VALVE_NODE_FAULT)]
    pressed = (Mode.FAULT, Reason.ESTOP_PRESSED)
    own_end = watched(*ramp, (Mode.FAULT, Reason.VALVE_NODE_FAULT), pressed)
    assert own_end.reached == {"R1": 1.0}, "the end of its own ramp is no other reaction"
    harder = watched(*ramp, pressed)
    assert harder.reached == {"R1": 1.0, "R0": 2.0} and harder.reason == "VALVE_NODE_FAULT"
