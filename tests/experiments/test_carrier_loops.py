"""The carrier's loops: the closed form of docs/reference/machines.md section 7.2, the running law against its response,
margins over all machines.
"""

from __future__ import annotations

import math
from dataclasses import replace

import control
import msgspec
import numpy as np
import pytest

from controller.estimation.joint_estimator import JointEstimator
from controller.laws.drive import AngleLaw, WaypointLaw
from experiments.loop_design import carrier as loops
from experiments.loop_design.carrier import CarrierCase, angle_spec, arm_loop, heading_loop, natural
from experiments.loop_design.loop import FREQUENCY_RAD_S, LawResponse, Spool, margins
from experiments.loop_design.study import MIN_GAIN_DB, MIN_PHASE_DEG, CaseSet
from machine.geometry.carrier import heading_rate_rad_s
from machine.loading.profile_file import load_profile

PROFILE = load_profile("aoro_fc8")
CARRIER = PROFILE.carrier
assert CARRIER is not None
T_S, LEAD_S = 0.005, 0.003
S = 1j * FREQUENCY_RAD_S
QUICK = Spool(0.0, 1.0, 1e4, 1.0)
VALVE = Spool(0.075, 1.0, 40.0, 0.8)
SPREAD = CaseSet({}, {"steer": VALVE, "arm_fl": VALVE}, tuple(np.linspace(0.04, 0.15, 5)), (0.8, 1.0, 1.2))


@pytest.mark.parametrize("speed", [0.3, 0.639, 1.0])
def test_the_ideal_heading_loop_has_the_poles_of_the_closed_form(speed):
    base, kp, rear = CARRIER.front_axle_m + CARRIER.rear_axle_m, CARRIER.heading_kp_1_s, CARRIER.rear_axle_m
    closed = control.feedback(control.tf([kp * rear, kp * speed], [base, 0.0, 0.0]))
    frequencies, dampings, _ = control.damp(closed, doprint=False)
    w, zeta = natural(CARRIER, speed)
    assert math.prod(frequencies) == pytest.approx(w * w, rel=1e-6)
    if zeta < 1.0:
        assert dampings == pytest.approx([zeta, zeta], rel=1e-6)
    else:
        assert sum(frequencies) == pytest.approx(2.0 * zeta * w, rel=1e-6)


def test_a_quick_valve_and_receiver_leave_the_closed_form():
    case = CarrierCase(0.0, 1.0, 0.639)
    slow = FREQUENCY_RAD_S < 0.2
    base, kp, rear = CARRIER.front_axle_m + CARRIER.rear_axle_m, CARRIER.heading_kp_1_s, CARRIER.rear_axle_m
    ideal = kp * (rear * S + 0.639) / (base * S * S)
    assert np.abs(heading_loop(CARRIER, QUICK, case) / ideal - 1.0)[slow].max() < 0.01


def test_without_the_rear_axle_the_loop_is_not_damped():
    """Only lr g' damps it: docs/reference/machines.md section 13, trap 3."""
    bare = msgspec.structs.replace(CARRIER, rear_axle_m=1e-6)
    case = CarrierCase(0.075, 1.0, 0.639, math.inf, 0.1)
    assert margins(FREQUENCY_RAD_S, heading_loop(bare, VALVE, case), 2).phase_deg < 0.0
    assert margins(FREQUENCY_RAD_S, heading_loop(CARRIER, VALVE, case), 2).phase_deg > 50.0


@pytest.mark.parametrize("distance", [math.inf, 3.0])
@pytest.mark.parametrize("gain", [0.5, 1.0, 8.0])
def test_margins_of_two_and_three_integrators_agree_with_python_control(distance, gain):
    loop = gain * heading_loop(CARRIER, VALVE, CarrierCase(0.075, 1.0, 0.639, distance, 0.1))
    found = margins(FREQUENCY_RAD_S, loop, 2 if math.isinf(distance) else 3)
    all_gains, all_phases, *_ = control.stability_margins(
        control.FrequencyResponseData(loop, FREQUENCY_RAD_S), returnall=True
    )
    decibels = 20.0 * np.log10(all_gains)
    assert min(abs(abs(decibels) - abs(found.gain_db))) < 0.1
    if found.phase_deg > 0.0:
        assert min(abs(abs(all_phases) - found.phase_deg)) < 1.0
    assert (found.gain_db > 0.0) is (gain < 8.0), "eight times as much is too much"


@pytest.mark.parametrize("w", [0.5, 2.0, 6.0])
def test_the_response_of_the_angle_law_is_that_of_its_code(w):
    """The running estimator and law, driven by a sine of the articulation about a moving reference."""
    spec = angle_spec(CARRIER)
    spec = msgspec.structs.replace(spec, encoder=msgspec.structs.replace(spec.encoder, unit_per_count=1e-9))
    estimator, law = JointEstimator(spec, T_S), AngleLaw(CARRIER, T_S)
    period_ns, lead_ns, small, speed = round(T_S * 1e9), round(LEAD_S * 1e9), 1e-4, 0.02
    samples, times = [], []
    for k in range(round(60.0 / T_S)):
        now_ns = (k + 1) * period_ns
        t, sampled = now_ns * 1e-9, (now_ns - lead_ns) * 1e-9
        estimator.predict(now_ns)
        estimator.update(speed * sampled - small * math.sin(w * sampled), now_ns - lead_ns)
        rate = law.step(speed * t, speed, estimator.position)
        law.note_command(rate, speed, T_S)
        samples.append(rate - speed)
        times.append(t)
    half = len(times) // 2
    count = round(round((times[-1] - times[half]) * w / math.tau) * math.tau / w / T_S)
    y, at = np.array(samples[-count:]), np.array(times[-count:])
    found = 2.0 * np.mean((y - y.mean()) * np.exp(-1j * w * at)) * 1j / small
    wanted, _ = LawResponse(spec, T_S, LEAD_S).response(np.array([1j * w]))
    assert abs(found - wanted[0]) < 0.02 * abs(wanted[0])


def test_the_running_waypoint_law_settles_as_its_damping_says():
    """A small error of the heading on rigid geometry with a quick valve: the closed form's overshoot."""
    speed, law, psi, bend, ticks = 0.639, WaypointLaw(CARRIER), 0.05, 0.0, 4000
    trace = []
    for _ in range(ticks):
        rate = law.step(1e6, 0.0, psi)
        bend += rate * T_S
        psi += heading_rate_rad_s(CARRIER, speed, bend, rate) * T_S
        trace.append(psi)
    w, zeta = natural(CARRIER, speed)
    s = control.tf("s")
    base, rear = CARRIER.front_axle_m + CARRIER.rear_axle_m, CARRIER.rear_axle_m
    # psi(0) = 0.05 is left over from the response to a step of that size.
    step = CARRIER.heading_kp_1_s * (rear * s + speed) / (base * (s * s + 2.0 * zeta * w * s + w * w))
    t = np.arange(1, ticks + 1) * T_S
    _, expected = control.step_response(step, t)
    assert np.abs(np.array(trace) - 0.05 * (1.0 - expected))[50:].max() < 0.05 * 0.05


def test_the_shipped_gains_keep_their_margins_over_all_machines():
    made = loops.studies(PROFILE, SPREAD)
    assert [loop.name for loop in made] == ["heading", "articulation", "swing arm"]
    for loop in made:
        assert loop.phase_deg >= MIN_PHASE_DEG and loop.gain_db >= MIN_GAIN_DB, (loop.name, loop.worst)
    assert len(made[0].cases) == 180
    assert loops.studies(load_profile("palms_471"), SPREAD) == []


def test_twice_the_gains_lose_their_margins():
    eager = msgspec.structs.replace(CARRIER, heading_kp_1_s=6.0, arm_kp_1_s=5.0)
    made = loops.studies(msgspec.structs.replace(PROFILE, carrier=eager), SPREAD)
    assert {loop.name for loop in made if not loop.holds} == {"heading", "swing arm"}
    late = arm_loop(CARRIER, replace(VALVE, delay_s=0.15))
    assert margins(FREQUENCY_RAD_S, late).phase_deg < margins(FREQUENCY_RAD_S, arm_loop(CARRIER, VALVE)).phase_deg
