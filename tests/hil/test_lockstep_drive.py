"""The machine drives over the bus, in lockstep with emulated nodes: to a waypoint and by angles of its articulation."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from can_dbc.messages.crane import StateReport
from can_dbc.messages.vehicle import Driving, Steering, VehicleReport
from controller.laws.drive import east_north_m
from hil.harness.lockstep import Lockstep, Observer
from hil.replay.recording import files_of
from hil.replay.replay import replay
from machine.status.modes import Mode
from machine.status.reasons import Reason
from recorder.manifest import describe
from recorder.recorder import Recorder
from sim.geometry import LocalFrame
from sim.kinematic import KinematicMachine
from sim.plant import Plant
from tests.hil.stand_ins import CARRIER, SETTINGS, Blind, Drives, advance, in_lockstep

pytestmark = pytest.mark.long
PROFILE = SETTINGS.profile
SITE = LocalFrame(CARRIER.site_lat_deg, CARRIER.site_lon_deg, 0.0)


def system_of(plant, planner: Drives, recorder: Recorder | None = None) -> tuple[Lockstep, list[StateReport]]:
    reports: list[StateReport] = []
    observer = Observer(recorder, [reports.append], [planner.hear])
    return in_lockstep(PROFILE.name, plant, planner, observer=observer, eyes=Blind()), reports


def place(east_m: float, north_m: float) -> dict[str, float]:
    latitude, longitude, _ = SITE.geodetic(east_m, north_m, 0.0)
    return {"latitude_deg": latitude, "longitude_deg": longitude}


def away_m(report: VehicleReport, east_m: float, north_m: float) -> float:
    """Distance of the front axle, by what the report says."""
    where = place(east_m, north_m)
    east, north = east_north_m(report.latitude_deg, report.longitude_deg, *where.values())
    ahead, yaw = CARRIER.front_axle_m - CARRIER.antenna_main_m[0], math.pi / 2 - report.heading_rad
    return math.hypot(east - ahead * math.cos(yaw), north - ahead * math.sin(yaw))


@pytest.fixture(scope="module")
def trip(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Drives, Lockstep, list[StateReport]]]:
    """In the physics: up to transport height, 5 m to a waypoint aside, and stop there."""
    directory = tmp_path_factory.mktemp("drive") / "run"
    plant = Plant(PROFILE, seed=3, truth="sampled", logs=0)
    goal = (7.0, 1.0)
    arrived: list[int] = []

    def say(report: VehicleReport, elapsed_ns: int) -> dict[str, object] | None:
        if away_m(report, *goal) < 0.4:
            arrived.append(elapsed_ns)
        if arrived and elapsed_ns - arrived[0] > 3e9:
            return None
        return place(*goal) | {"speed_m_s": 0.0 if arrived else 0.639, "float_rear": True}

    planner = Drives(say)
    buses = (PROFILE.crane_bus, PROFILE.machine_bus or "")
    recorder = Recorder(directory, PROFILE, describe(PROFILE, buses, 3))
    system, reports = system_of(plant, planner, recorder)
    advance(system, 25.0, lambda: bool(arrived) and system.report is not None and system.report.mode == Mode.ARMED)
    recorder.close()
    yield directory, planner, system, reports
    plant.close()


def test_it_drives_to_the_waypoint_and_stands_there(trip) -> None:
    _, planner, system, reports = trip
    modes = [r.mode for r in reports]
    assert [m for k, m in enumerate(modes) if k == 0 or m != modes[k - 1]][-3:] == [Mode.ARMED, Mode.ACTIVE, Mode.ARMED]
    carrier = system.plant.world.carrier
    x, y, _ = carrier.front_axle()
    assert math.hypot(x - 7.0, y - 1.0) < 0.5 and abs(carrier.speed_m_s) < 0.01
    assert {r.driving for r in planner.heard} == {Driving.STANDING, Driving.DRIVING}
    assert planner.heard[-1].refused == 0 and reports[-1].reason == Reason.NONE
    assert max(r.speed_m_s for r in planner.heard if r.motion_ns) == pytest.approx(0.639, rel=0.15)


def test_the_recording_has_the_vehicle_and_replays_to_the_same_bytes(trip) -> None:
    directory, planner, system, _ = trip
    with files_of(directory)[0].open("rb") as file:
        told = [json.loads(m.data) for *_, m in make_reader(file).iter_messages("/controller/vehicle")]
    assert len(told) == len(planner.heard) and told[-1]["sequence"] == planner.heard[-1].sequence
    result = replay(files_of(directory))
    assert result.agrees and result.ticks == system.ticks, result


def test_the_machine_stops_when_the_planner_dies_on_the_route() -> None:
    plant = Plant(PROFILE, seed=5, truth="sampled", logs=0)
    try:
        planner = Drives(lambda _, elapsed_ns: place(60.0, 0.0) | {"speed_m_s": 0.639} if elapsed_ns < 4e9 else None)
        system, reports = system_of(plant, planner)
        advance(system, 10.0, lambda: bool(reports) and reports[-1].mode == Mode.STOP)
        assert reports[-1].reason == Reason.LEASE_LOST and plant.world.carrier.speed_m_s > 0.5
        begin = plant.world.carrier.front_axle()
        advance(system, 2.0)
        stopped = plant.world.carrier.front_axle()
        assert math.dist(begin, stopped) < 0.45
        advance(system, 1.0)  # it rocks on its tyres, and stays where it is
        assert not system.guard.latched, "braking is no motion that nobody asked for"
        assert math.dist(stopped, plant.world.carrier.front_axle()) < 0.005
        assert planner.vehicle is not None and planner.vehicle.driving == Driving.STANDING
        assert Driving.BRAKING in {r.driving for r in planner.heard}
    finally:
        plant.close()


def test_arms_go_to_their_heights_and_level_a_slope() -> None:
    plant = Plant(PROFILE, seed=4, truth="sampled", logs=0, terrain="slope")
    try:
        say = {"heights_m": (0.3,) * 4, "level": False}
        planner = Drives(lambda *_: say)
        system, _ = system_of(plant, planner)
        advance(system, 6.0)
        assert planner.vehicle is not None
        assert planner.vehicle.heights_m == pytest.approx([0.3] * 4, abs=CARRIER.arm_in_band_m)
        assert abs(plant.world.carrier.roll_rad) > 0.08
        say["level"] = True
        advance(system, 12.0)
        assert abs(plant.world.carrier.roll_rad) < 0.03
        assert sum(planner.vehicle.heights_m) / 4 == pytest.approx(0.3, abs=0.02)
        say |= {"level": False, "heights_m": (0.05,) * 4}
        advance(system, 8.0)
        assert planner.vehicle.heights_m == pytest.approx([0.05] * 4, abs=CARRIER.arm_in_band_m)
    finally:
        plant.close()


class Rig(KinematicMachine):
    """The carrier of rigid geometry."""

    def logs(self) -> list:
        return []


def test_twenty_metres_of_rigid_geometry() -> None:
    rig = Rig(PROFILE, 7, "nominal", step_ns=2_500_000)
    goal = (16.0, 8.0)
    planner = Drives(lambda *_: place(*goal) | {"speed_m_s": 0.639})
    system, reports = system_of(rig, planner)
    carrier = rig.world.carrier
    assert carrier is not None
    advance(system, 60.0, lambda: math.hypot(carrier.x_m - goal[0], carrier.y_m - goal[1]) < 0.3)
    assert math.hypot(carrier.x_m - goal[0], carrier.y_m - goal[1]) < 0.3 and reports[-1].reason == Reason.NONE


def test_a_moving_articulation_angle_is_followed_on_rigid_geometry() -> None:
    rig = Rig(PROFILE, 8, "nominal", step_ns=2_500_000)
    errors: list[float] = []
    wanted = [0.0]

    def say(report: VehicleReport, elapsed_ns: int) -> dict[str, object]:
        t = elapsed_ns * 1e-9
        wanted[0], rate = 0.3 * math.sin(0.4 * t), 0.12 * math.cos(0.4 * t)
        errors.append(wanted[0] - report.articulation_rad)
        steer = {"steering": Steering.ARTICULATION, "articulation_rad": wanted[0], "articulation_rate_rad_s": rate}
        return steer | {"speed_m_s": 0.5}

    system, reports = system_of(rig, Drives(say))
    advance(system, 20.0)
    assert reports[-1].mode == Mode.ACTIVE and reports[-1].reason == Reason.NONE
    settled = errors[len(errors) // 4 :]
    assert max(map(abs, settled)) < 0.03  # of which 0.006 are the age of the report
