"""The linear loops of crane and carrier: margins against python-control and closed forms, the controller's response
against its code, the plant's against its physics, and the margins of the shipped gains over all machines.
"""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import control
import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

import machine
from controller.estimation.joint_estimator import JointEstimator
from controller.laws.drive import AngleLaw, WaypointLaw
from controller.laws.feedback import LAWS
from controller.laws.joint import JointLaw
from controller.laws.valve_map import ValveMap
from experiments.common.worlds import home_at, trial_world
from experiments.loop_design import carrier as loops
from experiments.loop_design.carrier import CarrierCase, angle_spec, arm_loop, heading_loop, natural
from experiments.loop_design.loop import FREQUENCY_RAD_S, LawResponse, Spool, margins, open_loop
from experiments.loop_design.mechanics import mechanics
from experiments.loop_design.page import with_law, write
from experiments.loop_design.study import MIN_GAIN_DB, MIN_PHASE_DEG, CaseSet, case_set, study
from host.exit_codes import CommandFailed, ExitCode
from machine.geometry.carrier import heading_rate_rad_s
from machine.loading.profile_file import load_profile
from machine.profile import JointSpec, Profile
from timberhand.cli import app

T_S, LEAD_S = 0.005, 0.0025
S = 1j * FREQUENCY_RAD_S
KINDS = ("pd", "pd_plain", "pid", "sliding_mode", "sliding_mode_pe", "super_twisting")


def tuned(profile: Profile, part: str = "law", **changed: object) -> Profile:
    """The profile with other numbers in the law, or another part, of every joint."""
    joints = {
        name: msgspec.structs.replace(spec, **{part: msgspec.structs.replace(getattr(spec, part), **changed)})
        for name, spec in profile.joints.items()
    }
    return msgspec.structs.replace(profile, joints=joints)


def spec_of(kind="pd", name="slew", **law):
    spec = load_profile("palms_471").joints[name]
    return msgspec.structs.replace(spec, law=msgspec.structs.replace(spec.law, kind=kind, **law))


@pytest.fixture(scope="module")
def works():
    return {name: case_set(name) for name in ("palms_471", "aoro_fc8")}


def test_margins_of_an_integrator_with_a_dead_time():
    """Phase margin 90 deg - gain times delay, gain margin pi / 2 over it."""
    gain, delay_s = 2.0, 0.15
    found = margins(FREQUENCY_RAD_S, gain / S * np.exp(-S * delay_s))
    assert found.phase_deg == pytest.approx(90.0 - math.degrees(gain * delay_s), abs=0.05)
    assert found.gain_db == pytest.approx(20.0 * math.log10(math.pi / 2.0 / (gain * delay_s)), abs=0.02)
    assert found.crossover_rad_s == pytest.approx(gain, rel=1e-3)


@pytest.mark.parametrize(
    ("gain", "w", "zeta", "delay_s"), [(1.0, 8.0, 0.2, 0.1), (2.0, 5.0, 0.4, 0.05), (0.7, 20.0, 0.05, 0.2)]
)
def test_margins_agree_with_python_control(gain, w, zeta, delay_s):
    loop = gain / S * np.exp(-S * delay_s) * w * w / (S * S + 2.0 * zeta * w * S + w * w)
    found = margins(FREQUENCY_RAD_S, loop)
    gm, pm, *_ = control.stability_margins(control.FrequencyResponseData(loop, FREQUENCY_RAD_S))
    assert found.gain_db == pytest.approx(20.0 * math.log10(gm), abs=0.2)
    assert found.phase_deg == pytest.approx(pm, abs=0.5)


def test_an_unstable_loop_has_no_margin():
    found = margins(FREQUENCY_RAD_S, 20.0 / S * np.exp(-S * 0.15))
    assert found.gain_db < 0.0 and found.phase_deg < 0.0


def finely_encoded(spec: JointSpec) -> JointSpec:
    """The joint with an encoder whose steps are too small to matter."""
    return msgspec.structs.replace(spec, encoder=msgspec.structs.replace(spec.encoder, unit_per_count=1e-9))


def response_of_code(
    spec: JointSpec, w: float, small: float, rate: Callable[[float, JointEstimator], float], speed: float = 0.02
) -> complex:
    """The response of the running estimator and law to a sine of the joint about a moving reference.

    ``rate`` is what the law makes of the reference and the estimate.
    """
    period_ns, lead_ns = round(T_S * 1e9), round(LEAD_S * 1e9)
    estimator, samples, times = JointEstimator(spec, T_S), [], []
    for k in range(round(60.0 / T_S)):
        now_ns = (k + 1) * period_ns
        t, sampled = now_ns * 1e-9, (now_ns - lead_ns) * 1e-9
        estimator.predict(now_ns)
        estimator.update(speed * sampled - small * math.sin(w * sampled), now_ns - lead_ns)
        samples.append(rate(speed * t, estimator) - speed)
        times.append(t)
    half = len(times) // 2
    turns = round((times[-1] - times[half]) * w / math.tau)
    count = round(turns * math.tau / w / T_S)
    y, at = np.array(samples[-count:]), np.array(times[-count:])
    return complex(2.0 * np.mean((y - y.mean()) * np.exp(-1j * w * at)) * 1j / small)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("w", [1.0, 4.0, 9.0])
def test_the_controllers_response_is_that_of_its_code(kind, w):
    spec = finely_encoded(spec_of(kind, kd=0.1, damping_per_bar=0.0))
    small = 1e-3 * spec.law.layer if kind != "super_twisting" else spec.law.layer
    law = JointLaw(spec, ValveMap(spec.valve), T_S)
    law._gain = None  # the joint of this test does not answer its commands

    def rate(reference: float, estimator: JointEstimator) -> float:
        law.desired_velocity(reference, 0.02, 0.02, estimator.position, estimator.velocity, math.nan, T_S)
        commanded = law.command(1.0, T_S)
        law._max_rate = math.inf
        return commanded

    wanted, _ = LawResponse(spec, T_S, LEAD_S).response(np.array([1j * w]))
    # The describing function of |e|^1.5 at an amplitude of the layer lies below its chord.
    near = 0.12 if kind == "super_twisting" else 0.02
    assert abs(response_of_code(spec, w, small, rate) - wanted[0]) < near * abs(wanted[0])


def test_a_standing_joint_passes_the_metered_oil_one_to_one():
    with trial_world("palms_471", "nominal", 0, home=home_at("palms_471", 4.0, 1.0)) as world:
        for name in ("slew", "lift", "tilt", "ext", "rot"):
            made = mechanics(world, name, 100.0)
            low, high = made.response(np.array([1e-3j, 400j]))
            assert abs(low - 1.0) < 1e-3
            assert abs(high) < 0.5 or name == "ext"


def test_inertia_and_springs_are_those_of_a_hand_calculation():
    with trial_world("palms_471", "nominal", 0, home=home_at("palms_471", 5.0, 1.0)) as world:
        slew = mechanics(world, "slew")
        q, supply, c = world.q["slew"], world.truth.supply, world.truth.functions["slew"].cylinder
        volume = c.dead_volume_m3 + c.area_a * (q - c.arm_at[0])
        assert slew.filling.spring == pytest.approx(supply.bulk_modulus_pa * c.area_a**2 / volume, rel=1e-3)
        pin = world.crane.pose("hanger")[0]
        hanging = sum(world.truth.links[n].mass_kg for n in ("hanger", "fork", "rotator")) + 40.0
        assert slew.swinging == pytest.approx(hanging * (pin[0] ** 2 + pin[1] ** 2), rel=1e-3)
        assert mechanics(world, "ext").inertia == pytest.approx(25.0, abs=hanging)
        loaded = mechanics(world, "slew", 100.0)
        assert loaded.swinging > slew.swinging and loaded.pendulum_rad_s < slew.pendulum_rad_s


@pytest.mark.long
def test_a_longer_delay_costs_phase_and_a_higher_gain_costs_gain(works):
    spec, work = spec_of(name="lift"), works["palms_471"]
    made, valve = work.places["lift"][0][1], work.valves["lift"]

    def margins_of(delay_s, gain):
        law = LawResponse(spec, T_S, LEAD_S)
        spool = Spool(delay_s, gain, valve.rad_s, valve.zeta)
        return margins(FREQUENCY_RAD_S, open_loop(S, spec, law, made, spool, T_S))

    assert margins_of(0.15, 1.0).phase_deg < margins_of(0.04, 1.0).phase_deg
    assert margins_of(0.075, 1.2).gain_db == pytest.approx(
        margins_of(0.075, 1.0).gain_db - 20.0 * math.log10(1.2), abs=1e-6
    )


@pytest.mark.long
@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_the_shipped_gains_keep_their_margins_over_all_machines(works, name):
    for joint in study(load_profile(name), works[name]):
        assert joint.phase_deg >= MIN_PHASE_DEG and joint.gain_db >= MIN_GAIN_DB, (joint.name, joint.worst)
        assert len(joint.cases) == 360


@pytest.mark.long
def test_the_old_gains_lose_their_margins(works):
    """3 1/s on every joint: what the bound of the dead time alone allows."""
    old = tuned(load_profile("palms_471"), kp_1_s=3.0, damping_per_bar=0.0)
    assert {j.name for j in study(old, works["palms_471"]) if not j.holds} >= {"slew", "lift"}


@pytest.mark.long
@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_law_keeps_the_margins_with_the_same_gain(works, name, kind):
    for joint in study(with_law(load_profile(name), kind), works[name]):
        assert joint.holds, (joint.name, joint.phase_deg, joint.gain_db, joint.worst)


@pytest.mark.long
@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
@pytest.mark.parametrize("delay_s", [0.04, 0.15])
def test_a_profile_calibrated_to_either_end_of_the_spread_keeps_its_margins(works, name, delay_s):
    """Over all dead times, although it compensates for one of them."""
    for joint in study(tuned(load_profile(name), "valve", delay_s=delay_s), works[name]):
        assert joint.holds, (joint.name, joint.phase_deg, joint.gain_db, joint.worst)


@pytest.mark.long
def test_the_page_has_every_law_of_every_joint(works, tmp_path):
    profile = load_profile("palms_471")
    few = replace(works["palms_471"], delays_s=(0.08,), gains=(1.0,))
    assert write([(profile, study(profile, few), few)], tmp_path)
    document = json.loads((tmp_path / "results" / "loop-design.json").read_text())
    assert set(document["machines"]["palms_471"]) == {*LAWS, "undamped"} and document["reached"]
    eager = tuned(profile, kind="pd", kp_1_s=12.0)
    assert not write([(eager, study(eager, few), few)], tmp_path)


@pytest.mark.long
def test_the_command_prints_draws_and_fails(tmp_path):
    done = CliRunner().invoke(app, ["bench", "loop-design", "--profile", "palms_471", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["reached"] and set(document["machines"]["palms_471"]) == {"slew", "lift", "tilt", "ext", "rot"}
    lift = document["machines"]["palms_471"]["lift"]
    assert lift["worst_by_python_control"]["gain_db"] == pytest.approx(lift["gain_margin_db"], abs=0.1)
    eager = tmp_path / "eager.toml"
    text = (Path(machine.__file__).parent / "palms_471.toml").read_text()
    eager.write_text(text.replace("kp_1_s = 2.0 ", "kp_1_s = 5.0 "))
    failed = CliRunner().invoke(app, ["bench", "loop-design", "--profile", str(eager)])
    assert failed.exit_code == ExitCode.FIGURE_MISSED, failed.output
    refused = CliRunner().invoke(app, ["bench", "loop-design", "--profile", "nothing"])
    assert isinstance(refused.exception, CommandFailed) and refused.exception.exit_code is ExitCode.CONFIGURATION


# -- the carrier: the closed form of docs/reference/machines.md section 7.2

AORO = load_profile("aoro_fc8")
CARRIER = AORO.carrier
assert CARRIER is not None
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
    spec, law = finely_encoded(angle_spec(CARRIER)), AngleLaw(CARRIER, T_S)

    def rate(reference: float, estimator: JointEstimator) -> float:
        commanded = law.step(reference, 0.02, estimator.position)
        law.note_command(commanded, 0.02, T_S)
        return commanded

    wanted, _ = LawResponse(spec, T_S, LEAD_S).response(np.array([1j * w]))
    assert abs(response_of_code(spec, w, 1e-4, rate) - wanted[0]) < 0.02 * abs(wanted[0])


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


def test_the_carriers_shipped_gains_keep_their_margins_over_all_machines():
    made = loops.studies(AORO, SPREAD)
    assert [loop.name for loop in made] == ["heading", "articulation", "swing arm"]
    for loop in made:
        assert loop.phase_deg >= MIN_PHASE_DEG and loop.gain_db >= MIN_GAIN_DB, (loop.name, loop.worst)
    assert len(made[0].cases) == 180
    assert loops.studies(load_profile("palms_471"), SPREAD) == []


def test_twice_the_gains_lose_their_margins():
    eager = msgspec.structs.replace(CARRIER, heading_kp_1_s=6.0, arm_kp_1_s=5.0)
    made = loops.studies(msgspec.structs.replace(AORO, carrier=eager), SPREAD)
    assert {loop.name for loop in made if not loop.holds} == {"heading", "swing arm"}
    late = arm_loop(CARRIER, replace(VALVE, delay_s=0.15))
    assert margins(FREQUENCY_RAD_S, late).phase_deg < margins(FREQUENCY_RAD_S, arm_loop(CARRIER, VALVE)).phase_deg
