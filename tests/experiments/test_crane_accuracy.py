"""The crane-accuracy experiment: the shortest time, metrics of a motion, its planner, the command."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from autonomy.motion.arm_kinematics import Arm
from autonomy.motion.trajectory import straight_line
from can_dbc.messages.crane import CraneSetpoint, StateReport
from can_dbc.messages.datagrams import decode
from experiments.common.minimum_time import Limits, full_limits, minimum_time_s
from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.crane_accuracy import experiment, measure
from experiments.crane_accuracy.measure import Trace
from experiments.crane_accuracy.metrics import gather
from experiments.crane_accuracy.plan import (
    GOALS_M,
    LAWS,
    OWN,
    REPETITIONS,
    UNCALIBRATED,
    UNCOMPENSATED,
    UNSHAPED,
    Visit,
    pose_at,
    start_pose,
    variants,
    visits,
)
from experiments.crane_accuracy.reach_cycles import Phase, ReachCycles
from experiments.crane_accuracy.trial import varied
from machine.geometry.kinematics import pin_position
from machine.loading.profile_file import load_profile, profile_hash
from machine.profile import Sag
from machine.status.modes import Mode
from tests.console.state_reports import at

AORO = load_profile("aoro_fc8")
TICK_NS = 20_000_000


def limits(speed: float, acceleration: float, flow: float = 0.0, pump: float = 1.0, **lever: Any) -> Limits:
    """Two joints; the first one's valve takes ``flow`` per unit and has the lever."""
    table = (lever["at"], lever["share"]) if lever else ((), ())
    flows = np.array([flow, 0.0])
    return Limits(np.full(2, speed), np.full(2, acceleration), flows, 2.0 * flows, (table, ((), ())), pump)


def line(way: float) -> np.ndarray:
    """The first joint goes a way; its samples are dense at the ends, as those of a smooth motion."""
    done = (1.0 - np.cos(np.linspace(0.0, math.pi, 60))) / 2.0
    return np.column_stack([way * done, np.zeros(60)])


def test_the_shortest_time_of_a_straight_path_is_the_textbook_value():
    assert minimum_time_s(line(0.5), limits(9.0, 2.0)) == pytest.approx(2.0 * math.sqrt(0.5 / 2.0), rel=1e-3)
    assert minimum_time_s(line(3.0), limits(1.0, 2.0)) == pytest.approx(3.0 / 1.0 + 1.0 / 2.0, rel=1e-3)
    assert minimum_time_s(line(3.0)[:1], limits(1.0, 2.0)) == 0.0


def test_the_pump_bounds_the_cruise_on_either_side_and_by_the_lever():
    # 2 m^3 a unit from a pump of 1 m^3/s: half a unit a second; the other side takes twice that.
    assert minimum_time_s(line(3.0), limits(9.0, 1.0, flow=2.0)) == pytest.approx(3.0 / 0.5 + 0.5, rel=1e-3)
    assert minimum_time_s(-line(3.0), limits(9.0, 1.0, flow=2.0)) == pytest.approx(3.0 / 0.25 + 0.25, rel=1e-3)
    half = limits(9.0, 1.0, flow=2.0, at=(0.0, 1.0), share=(0.5, 0.5))
    assert minimum_time_s(line(3.0), half) == pytest.approx(3.0 / 1.0 + 1.0, rel=1e-3)


def test_a_bend_costs_acceleration_of_the_joint_that_turns():
    # Round a circle of radius 1 at speed v one joint's acceleration is v^2 at every quarter, both share it in between.
    angle = np.linspace(0.0, 10.0 * math.pi, 600)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    time_s = minimum_time_s(circle, limits(9.0, 1.0))
    assert 10.0 * math.pi / 2.0**0.25 < time_s < 10.0 * math.pi + 2.0
    assert minimum_time_s(circle, limits(9.0, 4.0)) == pytest.approx(time_s / 2.0, rel=1e-3)


def test_the_timing_of_the_samples_does_not_count_and_no_plan_is_faster():
    arm, full = Arm(AORO), full_limits(AORO)
    start, goal = np.array(start_pose(arm)), np.array(pose_at(arm, GOALS_M[2]))
    slow, even = (
        arm.joints(start + d[:, None] * (goal - start)) for d in (line(1.0)[:, 0], np.linspace(0.0, 1.0, 120))
    )
    shortest = minimum_time_s(even, full)
    assert minimum_time_s(slow, full) == pytest.approx(shortest, rel=5e-3)
    planned = straight_line(arm, start_pose(arm), pose_at(arm, GOALS_M[2]))
    assert minimum_time_s(np.array(planned.position), full) < planned.duration_s


def trace(error: Callable[[np.ndarray], np.ndarray], shut_from_s: float = 0.0) -> Trace:
    """A pin that approaches (1, 2, 3) from the side with an error over time [m]; the true one is 5 cm lower."""
    time = np.arange(0.0, 12.0, 0.02)
    pin = np.array([1.0, 2.0, 3.0]) + np.outer(error(time), [1.0, 0.0, 0.0])
    command = np.arange(0.0, 12.0, 0.005)
    lean = np.where(time < 7.0, 5.0, 2.0)
    return Trace(time, pin, pin - [0.0, 0.0, 0.05], lean, command, command >= shut_from_s)


def test_a_motion_is_over_when_the_pin_stays_near_its_end():
    found = measure.motion_metrics(
        trace(lambda t: np.maximum(0.004, 1.0 - t / 4.0)), (1.0, 2.0, 3.0), (1.0, 2.0, 2.99), 5.0
    )
    assert found["motion_s"] == pytest.approx(3.92, abs=0.021) and found["arrived_s"] == 5.0
    assert found["encoder_m"] == pytest.approx([0.004, 0.0, 0.0])
    assert found["encoder_to_goal_m"] == pytest.approx([0.004, 0.0, 0.01])
    assert found["true_m"] == pytest.approx([0.004, 0.0, -0.04])
    assert found["swing_deg"] == 5.0, "from 6 to 8 s; it swings until 7 s"
    assert (found["shut"], found["commands"]) == (1000, 1000)


def test_a_pin_that_leaves_again_has_not_arrived_before():
    left = measure.motion_metrics(
        trace(lambda t: np.where((t > 6.0) & (t < 6.5), 0.03, 0.0)), (1.0, 2.0, 3.0), (0,) * 3, 5.0
    )
    assert left["motion_s"] == left["arrived_s"] == pytest.approx(6.5, abs=0.021)
    assert left["swing_deg"] == 5.0, "the grapple does not wait for the pin"
    assert measure.motion_metrics(trace(lambda t: 0.0 * t), (1.0, 2.0, 3.0), (0,) * 3, 6.1)["swing_deg"] == 2.0
    never = measure.motion_metrics(trace(lambda t: 0.03 + 0.0 * t, 9.0), (1.0, 2.0, 3.0), (0,) * 3, 5.0)
    assert never["motion_s"] is None and never["arrived_s"] == 5.0
    assert never["shut"] == pytest.approx(600, abs=1) and never["commands"] == 1000


def test_the_points_are_the_papers():
    made = visits(REPETITIONS)
    assert len(made) == 80 and sum(v.load_kg == 200.0 for v in made) == 40
    assert [v.goal for v in made[:5]] == [0, 1, 2, 3, 0]
    assert [v.load_kg for v in made] == sorted(v.load_kg for v in made), "the load is put on once"
    assert sorted((v.goal, v.load_kg) for v in visits(1)) == [(0, 0.0), (1, 200.0), (2, 200.0), (3, 0.0)]
    assert len(visits(3)) == 12 and sum(v.load_kg > 0.0 for v in visits(3)) == 6


def test_a_variant_changes_only_the_law_or_the_sag_model():
    known = msgspec.structs.replace(AORO, sag=Sag(1e-3, 1e-3, 1e-2))
    assert varied(known, OWN) is known and varied(known, UNSHAPED) is known
    assert varied(known, UNCOMPENSATED) == AORO
    assert {j.law.kind for j in varied(known, "super_twisting").joints.values()} == {"super_twisting"}
    assert OWN in variants("pd") and "pd" not in variants("pd") and set(LAWS) < set(variants(""))


def motion(goal: int = 0, load: float = 0.0, error: tuple[float, ...] = (0.003, 0.004, 0.0), **more: Any) -> dict:
    return {
        "goal": goal,
        "load_kg": load,
        "believed_kg": load,
        "failed": False,
        "encoder_m": list(error),
        "encoder_to_goal_m": [0.0, 0.0, 0.05],
        "true_m": [0.0, 0.0, 0.02],
        "motion_s": 6.0,
        "minimum_s": 5.0,
        "planned_s": 5.5,
        "arrived_s": 6.0,
        "swing_deg": 1.0,
        "shut": 95,
        "commands": 100,
        **more,
    }


def outcomes() -> dict[str, Any]:
    def ran(*motions: dict, missing: int = 0, stops: int = 0) -> dict[str, Any]:
        return {"motions": list(motions), "missing": missing, "stops": stops}

    return {
        "0/calibration": {"profile": "text", "failure": None},
        "1/calibration": {"profile": None, "failure": "aborted"},
        f"0/{OWN}": ran(
            motion(),
            motion(load=200.0, error=(0.0, 0.0, 0.015), swing_deg=2.0, motion_s=None),
            {"goal": 1, "load_kg": 0.0, "failed": True},
            missing=2,
            stops=1,
        ),
        "0/sliding_mode": ran(motion(error=(0.0, 0.0, 0.008))),
        f"0/{UNCOMPENSATED}": ran(motion(true_m=[0.0, 0.06, 0.08])),
        f"0/{UNCALIBRATED}": ran(motion(encoder_to_goal_m=[0.0, 0.03, 0.04])),
        f"0/{UNSHAPED}": ran(motion(swing_deg=6.0)),
    }


def test_metrics_are_means_over_the_points_of_their_variant():
    m = gather(outcomes(), "pd")
    assert m["encoder_error_mean_m"] == m["pd.encoder_error_mean_m"] == pytest.approx(0.010)
    assert m["encoder_error_xy_mean_m"] == pytest.approx(0.0025) and m["encoder_error_z_mean_m"] == 0.0075
    assert m["encoder_error_empty_mean_m"] == pytest.approx(0.005) and m["encoder_error_loaded_mean_m"] == 0.015
    assert m["smc.encoder_error_mean_m"] == 0.008 and "sta.encoder_error_mean_m" not in m
    assert m["tip_error_mean_m"] == 0.02 and m["tip_error_uncorrected_mean_m"] == pytest.approx(0.10)
    assert m["uncalibrated_error_mean_m"] == pytest.approx(0.05)
    assert m["time_ratio"] == pytest.approx(1.2) and m["ended"] == 0.5, "a motion that never ended has no time"
    assert m["limit_cycle_share"] == pytest.approx(0.05)
    assert m["pd.sway_reduction"] == m["sway_reduction"] and "smc.sway_reduction" not in m
    assert m["sway_residual_mean_deg"] == 1.5 and m["sway_reduction"] == pytest.approx(0.75)
    assert (m["stops"], m["failures"], m["calibration_failures"]) == (1.0, 3.0, 1.0)


class Echo:
    """A controller whose joints are at the newest setpoint, the lift ``off_rad`` off."""

    def __init__(self) -> None:
        self.mode, self.load_kg, self.off_rad = Mode.ARMED, 0.0, 0.0
        self.position = (0.0, 1.0, -2.0, 0.2, math.nan)
        self._setpoint: CraneSetpoint | None = None

    def hear(self, data: bytes | None) -> None:
        if data is not None:
            message = decode(data)
            assert isinstance(message, CraneSetpoint)
            self._setpoint = message

    def report(self, now_ns: int) -> StateReport:
        reference = (*self.position[:4], 0.0)
        if self._setpoint is not None:
            age_ns = now_ns - self._setpoint.stamp_ns
            reference = self._setpoint.knots[min(age_ns // 50_000_000, 8)].position
            self.position = (reference[0], reference[1] + self.off_rad, *reference[2:4], math.nan)
        told = {"profile_hash": profile_hash(AORO), "reference": reference, "load_kg": self.load_kg}
        return at(self.position, now_ns, self.mode, opening_pct=math.nan, clamp_bar=math.nan, **told)


def drive(cycles: ReachCycles, echo: Echo, seconds: float, from_ns: int = 1_000_000_000) -> int:
    now_ns = from_ns
    while now_ns < from_ns + seconds * 1e9 and not cycles.done:
        now_ns += TICK_NS
        echo.hear(cycles.step(now_ns, echo.report(now_ns), ()))
    return now_ns


def test_the_planner_goes_there_and_back_and_weighs_the_load():
    echo, hung = Echo(), []

    def hang(load_kg: float) -> None:
        hung.append((load_kg, cycles.phase, pin_position(AORO.kinematics, echo.position)))
        echo.load_kg = load_kg - 3.0

    cycles = ReachCycles(AORO, profile_hash(AORO), [Visit(2, 0.0), Visit(0, 200.0)], hang)
    drive(cycles, echo, 120.0)
    assert cycles.done and [r.visit.goal for r in cycles.runs] == [2, 0]
    assert [(load, phase) for load, phase, _ in hung] == [(200.0, Phase.PAUSE)]
    assert hung[0][2] == pytest.approx((3.0, 0.0, 3.5), abs=1e-6), "at the start, at rest"
    assert [r.load_kg for r in cycles.runs] == pytest.approx([0.0, 197.0])
    for run in cycles.runs:
        assert run.commanded_m == pytest.approx(run.goal_m, abs=1e-6), "no sag is known"
        assert run.begun_ns + run.motion.duration_s * 1e9 == pytest.approx(run.ended_ns, abs=6e7)
        assert run.over_ns - run.ended_ns == pytest.approx(3.5e9, abs=6e7) and not run.failed
        assert run.motion.at(0.0)[0][:4] == pytest.approx(cycles.runs[0].motion.at(0.0)[0][:4], abs=1e-6)


def test_the_rest_starts_when_the_pin_stays_near_and_ends():
    echo = Echo()
    cycles = ReachCycles(AORO, profile_hash(AORO), [Visit(0, 0.0), Visit(0, 0.0)], lambda kg: None)
    now_ns = 1_000_000_000
    for away_s, rest_s in ((2.0, 5.5), (99.0, 10.0)):
        while cycles.phase is not Phase.REST:
            now_ns = drive(cycles, echo, 0.1, now_ns)
        echo.off_rad = 0.02
        now_ns = drive(cycles, echo, min(away_s, 12.0), now_ns)
        echo.off_rad = 0.0
        while cycles.phase is Phase.REST:
            now_ns = drive(cycles, echo, 0.1, now_ns)
        assert cycles.runs[-1].over_ns - cycles.runs[-1].ended_ns == pytest.approx(rest_s * 1e9, abs=2e8)


def test_a_stop_fails_the_motion_and_the_next_one_follows_from_the_start():
    echo = Echo()
    cycles = ReachCycles(AORO, profile_hash(AORO), [Visit(1, 0.0), Visit(3, 0.0)], lambda kg: None)
    now_ns = 1_000_000_000
    while cycles.phase is not Phase.OUT:
        now_ns = drive(cycles, echo, 0.5, now_ns)
    echo.mode = Mode.STOP
    now_ns = drive(cycles, echo, 1.0, now_ns)
    assert cycles.phase is Phase.WAIT and cycles.runs[0].failed
    echo.mode = Mode.ARMED
    drive(cycles, echo, 60.0, now_ns)
    assert cycles.done and [r.failed for r in cycles.runs] == [True, False]


def test_repetitions_are_those_of_the_profiles_own_law_alone():
    machine = Job("0/calibration", "calibration", 1, {"profile": "aoro_fc8", "truth": "sampled"})
    texts = {machine.name: {"profile": "text"}}
    for asked, own in ((None, REPETITIONS), (6, 6)):
        jobs = experiment.motions([machine], texts, (OWN, UNCOMPENSATED), False, asked)
        assert [len(job.options["visits"]) for job in jobs] == [4 * own, 4]


@pytest.mark.long
@pytest.mark.timeout(600)
def test_the_experiment_calibrates_moves_and_writes_its_page(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "QUICK_GOALS", (2,))
    monkeypatch.setattr(experiment, "variants", lambda own: (OWN, UNCOMPENSATED))
    options = Options(
        seed=1, truth="nominal", profile="palms_471", out=tmp_path / "out", quick=True, docs=tmp_path / "docs"
    )
    result = experiment.run(options, Console(quiet=True))
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["experiment"] == "crane-accuracy" and document["profile"] == "aoro_fc8"
    m = result.metrics
    assert (m["stops"], m["failures"], m["calibration_failures"], m["ended"]) == (0.0, 0.0, 0.0, 1.0)
    assert m["encoder_error_mean_m"] < 0.02 and m["tip_error_mean_m"] < 0.03 < m["tip_error_uncorrected_mean_m"]
    assert set(result.missed) <= {"time_ratio", "limit_cycle_share", "encoder_error_mean_m", "encoder_error_xy_mean_m"}
