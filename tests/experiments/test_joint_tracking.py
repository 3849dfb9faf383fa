"""The joint-tracking experiment: its motions, one trial on the physics, its metrics, and the command."""

import json
import math

import msgspec
import numpy as np
import pytest
from rich.console import Console

from experiments.common.pool import Job
from experiments.common.registry import Options
from experiments.joint_tracking import experiment, individuals, motions
from experiments.joint_tracking.individuals import CORNERS
from experiments.joint_tracking.metrics import LAWS, sections
from experiments.joint_tracking.testbed import NAMES, Calibration
from experiments.joint_tracking.trial import _slow, perform
from machine.loading.profile_file import load_profile

PALMS = load_profile("palms_471")
START = [0.0, 0.4, -1.2, 0.6, 0.0]


def options(tmp_path, **more):
    return Options(seed=1, truth="nominal", profile="palms_471", out=tmp_path, **more)


@pytest.mark.parametrize("t", [0.31, 0.8, 1.4, 2.9, 4.1, 4.39])
@pytest.mark.parametrize("side", [1, -1])
def test_the_velocity_of_a_reference_is_its_derivative(t, side):
    for reference, _ in (
        motions.ramp(PALMS, START, "slew", side),
        (motions.legs(START, [(0.3, 4.0, {"slew": side * 0.4, "lift": 0.1})]), 4.3),
    ):
        (before, _), (now, v), (after, _) = reference(t - 1e-5), reference(t), reference(t + 1e-5)
        for a, b, speed in zip(before, after, v, strict=True):
            assert (b - a) / 2e-5 == pytest.approx(speed, abs=1e-6)
        assert len(now) == len(NAMES)


def test_references_rest_before_and_after():
    reference, over_s = motions.ramp(PALMS, START, "tilt", -1)
    assert reference(0.0) == (START, [0.0] * 5)
    q, v = reference(over_s + 1.0)
    assert not any(v) and q[2] < START[2] - 0.3
    stepped, begin_s = motions.step(PALMS, START, "ext", 1)
    assert stepped(begin_s - 0.01)[0] == START
    assert stepped(begin_s)[0][3] - START[3] == pytest.approx(motions.STEP_S * PALMS.joints["ext"].speed_limit)


def test_a_calibration_is_near_the_truth_and_repeats():
    class True_:
        deadband_plus, deadband_minus, full_speed_plus, full_speed_minus = 0.14, 0.1, 0.6, 0.4
        delay_s, exponent, hysteresis = 0.1, 1.1, 0.02

    shipped_valve = PALMS.joints["slew"].valve
    found = Calibration(3).valve(shipped_valve, True_)
    assert found == Calibration(3).valve(shipped_valve, True_) != Calibration(4).valve(shipped_valve, True_)
    assert found.deadband_plus_pct == pytest.approx(14.0, abs=2.0)
    assert found.full_speed_minus == pytest.approx(0.4, rel=0.1)
    assert found.hysteresis_pct == pytest.approx(2.0, abs=1.0)
    assert (found.exponent, found.signal, found.flow_plus) == (1.1, shipped_valve.signal, shipped_valve.flow_plus)


def test_every_law_is_tried_on_both_machines_and_the_same_individuals(tmp_path):
    jobs = experiment.plan(options(tmp_path), 2)
    cycles = [j for j in jobs if j.kind == "cycle"]
    assert {j.options["law"] for j in cycles} == set(LAWS)
    assert {j.options["profile"] for j in jobs} == {"palms_471", "aoro_fc8"}
    by_law = {law: sorted(j.seed for j in cycles if j.options["law"] == law) for law in LAWS}
    assert len({tuple(seeds) for seeds in by_law.values()}) == 1 and min(by_law["pd"]) >= 1000
    assert len({j.name for j in jobs}) == len(jobs)


def test_every_law_meets_every_corner_of_twice_the_spread_and_a_quick_run_is_short(tmp_path):
    jobs = experiment.plan(options(tmp_path), 1)
    for law in LAWS:
        for state in experiment.STATES:
            met = {j.options["corner"] for j in jobs if j.name.startswith(f"aoro/{law}/{state}/corner/")}
            assert met == set(range(8))
    assert len(experiment.plan(options(tmp_path, quick=True), 1)) < len(jobs) / 4


def test_metrics_are_means_counts_and_worst_values():
    wide = {"rest_m": [0.001, 0.003], "diverged": False, "alarms": 1, "trace": {}, "shut_share": 1.0}
    outcomes = {
        "palms/pd/shipped/wide/0": wide,
        "palms/pd/shipped/corner/1": {"rest_m": [0.002, 0.010], "diverged": True, "alarms": 2, "shut_share": 0.9},
        "palms/pd/shipped/corner/2": {"rest_m": [0.004, 0.004], "diverged": False, "alarms": 0, "shut_share": 0.8},
        "palms/stop/0": {"lift_empty_damped_ring_m": [0.001, 0.002], "lift_empty_plain_ring_m": [0.002, 0.004]},
    }
    metrics = experiment.gather(outcomes)
    assert metrics["palms_pd_shipped_corner_rest_m"] == pytest.approx(0.005)
    assert metrics["palms_pd_shipped_corner_rest_m_max"] == 0.010
    assert metrics["palms_pd_shipped_corner_diverged"] == 1.0 and metrics["palms_pd_shipped_corner_alarms"] == 2.0
    assert (metrics["palms_pd_twice_machines"], metrics["palms_pd_twice_diverged"]) == (3.0, 1.0)
    assert metrics["palms_pd_shipped_shut_share"] == pytest.approx(0.9)
    assert metrics["palms_stop_damped_over_plain"] == pytest.approx(0.5)


def test_machines_that_never_settle_miss_the_limit():
    never = {"shut_share": math.nan, "unsettled_share": 1.0, "diverged": False}
    found = experiment.gather({"palms/pd/shipped/wide/0": never})
    assert found["palms_pd_shipped_shut_share"] == 0.0 and found["palms_pd_shipped_unsettled_share"] == 1.0


def test_every_metric_has_its_own_name():
    shown = [f.name for s in sections({"palms": "pd", "aoro": "sliding_mode"}, {}) for f in s.metrics]
    assert len(shown) == len(set(shown)) and all(name.startswith(("palms_", "aoro_")) for name in shown)


def test_a_mean_over_a_window_is_the_mean_of_its_values():
    values = [float(k * k) for k in range(50)]
    slow = _slow(np.array(values), 0.5, 0.1)
    assert slow[20] == pytest.approx(np.mean(values[18:23])) and len(slow) == 50
    assert slow[0] == pytest.approx(np.mean([values[0]] * 3 + values[1:3]))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["cycle", "pump", "pick_up", "wide", "dip"])
def test_a_calibrated_machine_rests_near_and_closes_its_valves(kind):
    law = PALMS.joints["slew"].law.kind
    job = Job("t", kind, 3, {"profile": "palms_471", "truth": "sampled", "law": law, "calibrated": True})
    found = perform(job)
    assert max(found["rest_m"]) < 0.015 and found["shut_share"] > 0.9
    assert not found["diverged"] and (found["alarms"] == 0 or kind == "dip")
    assert (found["behind_s"] > 0.1) == (kind == "pump")


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_no_law_diverges_in_the_worst_corner_of_twice_the_spread(law):
    """Every joint 205 ms late and 1.4 times as fast as its profile says, with a load."""
    assert CORNERS[7] == (1, 1, True)
    what = {"profile": "aoro_fc8", "truth": "sampled", "law": law, "calibrated": False, "corner": 7}
    assert not perform(Job("t", "corner", 3, what))["diverged"]


@pytest.mark.long
def test_a_law_without_margins_diverges_there(monkeypatch):
    """Five times the budget: the figure can fail."""
    real = individuals.controller_profile

    def eager(*given):
        made = real(*given)
        joints = {
            n: msgspec.structs.replace(s, law=msgspec.structs.replace(s.law, kp_1_s=5.0 * s.law.kp_1_s))
            for n, s in made.joints.items()
        }
        return msgspec.structs.replace(made, joints=joints)

    monkeypatch.setattr(individuals, "controller_profile", eager)
    what = {"profile": "aoro_fc8", "truth": "sampled", "law": "pd", "calibrated": False, "corner": 7}
    assert perform(Job("t", "corner", 3, what))["diverged"]


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_experiment_writes_its_result_plots_and_page(tmp_path):
    result = experiment.run(options(tmp_path / "out", quick=True, docs=tmp_path / "docs"), Console(quiet=True))
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["experiment"] == "joint-tracking" and not result.missed, result.missed
    laws = {n: experiment.own_law(p) for n, p in experiment.machines(options(tmp_path)).items()}
    shown = [f.name for s in sections(laws, result.metrics) for f in s.metrics]
    others = [f"_{law}_" for law in LAWS if law not in laws.values()] + ["_matched_"]  # not part of a quick run
    own = [name for name in shown if not any(other in name for other in others)]
    assert all(math.isfinite(result.metrics[name]) for name in own) and len(own) > 15
