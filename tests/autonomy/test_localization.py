"""Localization: the plane, an honest covariance, gates, loss and return, frames of the machine."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.localization.frames import Frames
from autonomy.localization.local_plane import LocalPlane, wrapped, yaw_from_heading
from autonomy.localization.localizer import AGREEING_COUNT, Localizer
from autonomy.localization.location import Location, Status
from autonomy.localization.vehicle_filter import (
    SIZE,
    NoiseModel,
    Odometry,
    State,
    antenna_reach,
    front_attitude,
    predicted_antenna,
    predicted_state,
)
from can_dbc.messages.vehicle import DriveSetpoint, Steering, VehicleReport
from machine.loading.profile_file import load_profile
from sim.geometry import LocalFrame
from tests.autonomy.carrier_model import FIRM, MUD, SLOPE, Ground, Individual, Vehicle, heading_from_yaw, individual
from tests.codes import coded

CARRIER = load_profile("aoro_fc8").carrier
ANGLE = st.floats(-20.0, 20.0)


class Drive:
    """A machine that drives with a wavy articulation, and its localizer."""

    def __init__(self, ground: Ground = FIRM, own: Individual | None = None, seed: int = 0, bend_rad: float = 0.2):
        self.vehicle = Vehicle(CARRIER, (3.0, -2.0, 1.0), ground, own or individual(seed), seed)
        self.localizer = Localizer(CARRIER, self.vehicle.plane)
        self.bend_rad, self.speed_m_s = bend_rad, 0.6
        self.report: VehicleReport | None = None
        self.tamper = lambda report: report

    def on(self, seconds: float) -> list[Location]:
        """The locations during a drive of this duration."""
        out = []
        for _ in range(round(seconds * 200)):
            report = self.vehicle.step()
            if report is None:
                continue
            t = (report.stamp_ns - 10**9) * 1e-9
            bend_rad, rate_rad_s = self.bend_rad * math.sin(0.5 * t), 0.5 * self.bend_rad * math.cos(0.5 * t)
            steer = (Steering.ARTICULATION, 0.0, 0.0, bend_rad, rate_rad_s)
            self.vehicle.order(
                DriveSetpoint(1, 0, report.stamp_ns, 10**9, *steer, self.speed_m_s, (0.35,) * 4, False, False)
            )
            self.report = self.tamper(report)
            out.append(self.localizer.step(self.report))
        return out

    def off(self, location: Location) -> np.ndarray:
        """Error of x, y and yaw (3,)."""
        v = self.vehicle
        return np.array([location.x_m - v.x, location.y_m - v.y, wrapped(location.yaw_rad - v.yaw)])


@given(
    st.floats(-80.0, 80.0),
    st.floats(-179.0, 179.0),
    st.floats(-500.0, 500.0),
    st.floats(-500.0, 500.0),
    st.floats(-20.0, 20.0),
)
def test_the_plane_agrees_with_another_formula_and_inverts(lat, lon, east, north, up) -> None:
    plane, site = LocalPlane(lat, lon, 260.0), LocalFrame(lat, lon, 260.0)
    assert plane.local(*site.geodetic(east, north, up)) == pytest.approx((east, north, up), abs=1e-5)
    assert plane.local(*plane.geodetic(east, north, up)) == pytest.approx((east, north, up), abs=1e-5)


def test_an_invalid_origin_is_refused() -> None:
    for at in ((91.0, 0.0), (math.nan, 0.0), (0.0, 181.0), (0.0, 0.0, math.nan)):
        with pytest.raises(ValueError, check=coded("plane.origin")):
            LocalPlane(*at)


@given(ANGLE)
def test_headings_convert_to_yaws(heading: float) -> None:
    yaw = yaw_from_heading(heading)
    assert -math.pi <= yaw <= math.pi
    assert math.cos(yaw) == pytest.approx(math.sin(heading), abs=1e-9)
    assert wrapped(heading_from_yaw(yaw) - heading) == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=15)
@given(st.lists(st.floats(-0.3, 0.3), min_size=SIZE, max_size=SIZE), st.floats(-0.6, 0.6), st.floats(-0.05, 0.05))
def test_the_jacobians_are_those_of_the_model(x: list[float], bend: float, way: float) -> None:
    state, step = np.array(x), 1e-6
    odometry = Odometry(0.05, way, bend - 0.01, bend)
    reach = antenna_reach(CARRIER, 0.1, -0.05, 0.35)
    for function in (
        lambda v: predicted_state(CARRIER, NoiseModel(), v, odometry)[:2],
        lambda v: predicted_antenna(v, reach),
    ):
        _, jacobian = function(state)
        for k in range(SIZE):
            unit = step * np.eye(SIZE)[k]
            numeric = (function(state + unit)[0] - function(state - unit)[0]) / (2 * step)
            assert np.allclose(jacobian[:, k], numeric, atol=2e-6), State(k).name


@given(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.floats(-0.6, 0.6))
def test_the_front_leans_with_the_rear(roll: float, pitch: float, bend: float) -> None:
    front = front_attitude(roll, pitch, bend)
    assert front_attitude(*front, -bend) == pytest.approx((roll, pitch), abs=1e-9)


@pytest.mark.parametrize("ground", [FIRM, MUD, SLOPE], ids=["firm", "mud", "slope"])
def test_the_covariance_is_consistent(ground: Ground) -> None:
    """NEES of x, y and yaw at the end of six drives: chi square with 18 degrees of freedom, and not far below."""
    total = 0.0
    for seed in range(6):
        drive = Drive(ground, seed=seed, bend_rad=0.3 if seed % 2 else -0.3)
        location = drive.on(7.0)[-1]
        off = drive.off(location)
        total += float(off @ np.linalg.solve(location.covariance, off))
    assert 3.0 < total < 34.8  # 99 % below; the individuals are drawn a little tamer than the filter expects


def test_an_error_of_ten_centimetres_would_be_detected() -> None:
    """The bound of the test above is effective: an error of four sigmas is not consistent."""
    drive = Drive()
    location = drive.on(6.0)[-1]
    off = drive.off(location) + np.array([0.15, 0.0, 0.0])
    assert float(off @ np.linalg.solve(location.covariance, off)) > 16.0


def test_antenna_offsets_are_covered_by_the_covariance() -> None:
    drive = Drive(own=Individual(main_off_m=(0.03, -0.03)))
    location = drive.on(8.0)[-1]
    off = drive.off(location)
    assert np.hypot(*off[:2]) > 0.025 and location.sigma_m > 0.024
    assert float(off @ np.linalg.solve(location.covariance, off)) < 6.0


def test_delayed_measurements_are_used_at_their_time_of_validity() -> None:
    drive = Drive(replace(FIRM, spin=0.0, loose=0.0), Individual(wander_m=0.0), bend_rad=0.0)
    behind = []
    for _ in range(30):
        location = drive.on(0.5)[-1]
        behind.append(drive.off(location)[:2] @ (math.cos(drive.vehicle.yaw), math.sin(drive.vehicle.yaw)))
    assert np.mean(behind[10:]) == pytest.approx(0.0, abs=0.012)  # 75 ms are 4.5 cm


def test_slip_is_estimated() -> None:
    drive = Drive(MUD, Individual(), bend_rad=0.0)
    location = drive.on(20.0)[-1]
    assert location.speed_m_s == pytest.approx(drive.vehicle.speed, abs=0.03)
    assert drive.report is not None and drive.report.speed_m_s > 1.06 * location.speed_m_s
    drive = Drive(replace(SLOPE, loose=0.0), Individual(), bend_rad=0.0)
    drive.vehicle.yaw = 0.0
    locations = drive.on(15.0)
    drift = [wrapped(one.course_rad - one.yaw_rad) for one in locations[-100:]]
    assert np.mean(drift) == pytest.approx(-SLOPE.drift_rad, abs=0.02)


def test_one_outlier_position_is_rejected() -> None:
    drive = Drive()
    before = drive.on(5.0)[-1]
    drive.vehicle.jump_m = (4.0, -3.0)
    drive.on(0.1)
    drive.vehicle.jump_m = (0.0, 0.0)
    after = drive.on(0.4)[-1]
    assert drive.localizer.rejected > 0
    assert after.status is Status.TRACKING
    assert math.dist((after.x_m, after.y_m), (before.x_m, before.y_m)) < 0.5
    assert np.hypot(*drive.off(after)[:2]) < 0.08


def test_consistent_positions_elsewhere_are_accepted_after_a_loss() -> None:
    drive = Drive()
    drive.on(5.0)
    drive.vehicle.jump_m = (4.0, -3.0)
    during = drive.on(5.0)
    statuses = [one.status for one in during]
    lost = statuses.index(Status.LOST)
    assert statuses[lost - 1] is Status.DEAD_RECKONING
    assert "position" in during[lost].reason
    assert statuses[-1] is Status.TRACKING and during[-1].jumps == 1
    assert np.hypot(during[-1].x_m - drive.vehicle.x - 4.0, during[-1].y_m - drive.vehicle.y + 3.0) < 0.15


@pytest.mark.parametrize("turn_rad", [0.25, -0.4])
def test_a_machine_turned_at_standstill_recovers_its_heading(turn_rad: float) -> None:
    drive = Drive()
    drive.on(5.0)
    drive.speed_m_s = 0.0
    drive.on(4.0)
    drive.vehicle.yaw += turn_rad
    after = drive.on(6.0)
    assert Status.LOST in [one.status for one in after]
    assert after[-1].status is Status.TRACKING and after[-1].jumps
    x_m, y_m, yaw_rad = drive.off(after[-1])
    assert abs(yaw_rad) < 0.03 and math.hypot(x_m, y_m) < 0.1


def test_an_impossible_heading_is_rejected() -> None:
    drive = Drive()
    drive.on(5.0)
    drive.speed_m_s = 0.0
    drive.on(4.0)
    drive.vehicle.yaw += 1.2
    last = drive.on(8.0)[-1]
    assert last.status is Status.LOST and "heading" in last.reason


def test_two_seconds_without_satellites_are_dead_reckoned_then_lost() -> None:
    drive = Drive()
    drive.on(5.0)
    drive.vehicle.sky = False
    out = drive.on(4.0)
    last_fix = drive.report.position_ns
    for one in out:
        age = one.stamp_ns - last_fix
        if age > 2_000_000_000:
            assert one.status is Status.LOST and "position" in one.reason
        elif age > 600_000_000:
            assert one.status is Status.DEAD_RECKONING and one.reason
    reckoned = next(one for one in reversed(out) if one.status is Status.DEAD_RECKONING)
    assert reckoned.sigma_m > out[0].sigma_m
    drive.vehicle.sky = True
    back = drive.on(1.5)
    first = next(i for i, one in enumerate(back) if one.status is Status.TRACKING)
    assert first >= 2 * (AGREEING_COUNT - 1)  # two reports to a position
    assert np.hypot(*drive.off(back[-1])[:2]) < 0.1 and back[-1].jumps == 0


@pytest.mark.parametrize(("frozen", "heading_off_rad"), [(True, 0.0), (False, math.pi)], ids=["frozen", "swapped"])
def test_a_frozen_receiver_and_swapped_antennas_are_detected(frozen: bool, heading_off_rad: float) -> None:
    drive = Drive(own=Individual(heading_off_rad=heading_off_rad))
    drive.on(5.0)
    drive.vehicle.frozen = frozen
    assert drive.on(5.0)[-1].status is Status.LOST


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("latitude_deg", math.nan, "no position"),
        ("fix", 0, "no fix"),
        ("heading_rad", math.nan, "no heading"),
        ("heading_ns", 5, "no heading"),
        ("speed_m_s", math.nan, "speed and articulation"),
        ("articulation_rad", math.nan, "speed and articulation"),
        ("motion_ns", 5, "speed and articulation"),
    ],
)
@pytest.mark.parametrize("from_the_start", [False, True])
def test_the_reason_names_the_missing_input(field: str, value: float, reason: str, from_the_start: bool) -> None:
    drive = Drive()
    if not from_the_start:
        drive.on(3.0)
    drive.tamper = lambda report: replace(report, **{field: value})
    last = drive.on(3.0)[-1]
    assert not last.usable and last.status is (Status.STARTING if from_the_start else last.status)
    assert reason in last.reason


def test_unknown_roll_and_height_are_taken_as_level() -> None:
    drive = Drive()
    drive.tamper = lambda report: replace(report, roll_rad=math.nan, pitch_rad=math.nan, heights_m=(math.nan,) * 4)
    last = drive.on(5.0)[-1]
    assert last.usable and last.roll_rad == 0.0 and np.hypot(*drive.off(last)[:2]) < 0.1


def test_a_machine_that_turns_while_its_frame_sinks_on_a_hill_stays_located() -> None:
    """The braked wheels of one side creep farther than those of the other, and no wheel tells."""
    drive = Drive(bend_rad=0.0)
    drive.speed_m_s = 0.0
    drive.on(4.0)
    begun_ns, turn_rad = drive.report.stamp_ns, 0.05

    def sunk(report: VehicleReport) -> VehicleReport:
        share = min(1.0, (report.stamp_ns - begun_ns) * 1e-9 / 3.5)
        heading = report.heading_rad - share * turn_rad
        return replace(report, heading_rad=heading, heights_m=(0.35 * (1.0 - share),) * 4)

    drive.tamper = sunk
    before = drive.localizer.rejected
    on_the_way = drive.on(6.0)
    assert all(location.usable for location in on_the_way) and drive.localizer.rejected <= before + 2
    assert drive.off(on_the_way[-1])[2] == pytest.approx(turn_rad, abs=0.02)


def test_a_worse_fix_has_less_weight() -> None:
    good, poor = Drive().on(5.0)[-1], Drive(own=Individual(fix=5, white_m=0.05, wander_m=0.25))
    assert poor.on(5.0)[-1].sigma_m > 5.0 * good.sigma_m


def test_the_first_position_is_the_default_origin() -> None:
    drive = Drive()
    drive.localizer = Localizer(CARRIER)
    drive.on(2.0)
    assert drive.localizer.plane.altitude_m == 262.5
    assert math.dist(drive.localizer.plane.local(*drive.vehicle.plane.geodetic(3.0, -2.0)[:2])[:2], (0.0, 0.0)) < 4.0


def located(yaw_rad: float, articulation_rad: float = 0.0, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Location:
    """A location that is good to a millimetre."""
    at = Location(1, Status.TRACKING, "", 10.0, 5.0, 0.8, yaw_rad, np.eye(3) * 1e-6, 0.02)
    angles = {"articulation_rad": articulation_rad, "roll_rad": roll_rad, "pitch_rad": pitch_rad}
    return replace(at, front_height_m=CARRIER.arm_transport_m, **angles)


def test_a_level_straight_machine_has_its_crane_behind_its_axle() -> None:
    frames = Frames(CARRIER, located(yaw_rad=0.0))
    x, y, z = frames.base().position_m
    assert (x, y) == pytest.approx((10.0 - CARRIER.front_axle_m + CARRIER.crane_base_m[0], 5.0))
    assert z == pytest.approx(0.8 + CARRIER.arm_drop_low_m + CARRIER.arm_transport_m + CARRIER.crane_base_m[2])
    # Slew 0 points backwards.
    assert frames.base().to_base(np.array((4.0, 0.0, 0.0)))[0] < x - 3.9


@settings(max_examples=30)
@given(st.floats(-3.0, 3.0), st.floats(-0.6, 0.6), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_the_rear_frame_carries_the_front_axle_to_the_location(yaw, bend, roll, pitch) -> None:
    rear = Frames(CARRIER, located(yaw, bend, roll, pitch)).rear()
    ahead = np.array((math.cos(bend), math.sin(bend), 0.0))
    drop = np.array((0.0, 0.0, -(CARRIER.arm_drop_low_m + CARRIER.arm_transport_m)))
    assert rear.to_base(CARRIER.front_axle_m * ahead + drop) == pytest.approx((10.0, 5.0, 0.8), abs=1e-9)
    x, y, _ = rear.rotation @ ahead
    assert wrapped(math.atan2(y, x) - yaw) == pytest.approx(0.0, abs=1e-9)
