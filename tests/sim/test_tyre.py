"""One wheel against the closed forms of its model."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim.ground.terrain import Terrain
from sim.ground.tyre import Tyre, wheel_step

STEP_S = 0.0025
TYRE = Tyre(0.68, 0.6, 75.0, 4e5, 2e4, 5e5, 1.5e4, 0.30, 0.65, 0.03, 0.3)
LOAD_N = 24_000.0


class Wheel:
    """A wheel held at the height at which its tyre carries LOAD_N, moved along at a given velocity."""

    def __init__(self, tyre: Tyre = TYRE, terrain: Terrain | None = None, hub_x: float = 0.0) -> None:
        self.tyre, self.terrain = tyre, terrain or Terrain()
        self.arms = np.zeros((1, 16))
        self.arms[0, 6] = 1.0
        self.arms[0, [2, 9]] = self.loaded = tyre.radius_m - LOAD_N / tyre.stiffness_n_m
        self.hub_x = np.array([hub_x])
        self.spin, self.angle, self.bristle = np.zeros(1), np.zeros(1), np.zeros((1, 2))
        self.out, self.contact = np.zeros((1, 6)), np.zeros((1, 4))

    def run(self, seconds, velocity=(0.0, 0.0, 0.0), torque=0.0, brake=0.0, top=0.0):
        for _ in range(round(seconds / STEP_S)):
            self.arms[0, 0:3] += np.array(velocity) * STEP_S
            self.arms[0, 7:10] += np.array(velocity) * STEP_S
            self.arms[0, 10:13] = velocity
            state = (self.spin, self.angle, self.bristle)
            ground = self.terrain.grid
            wheel_step(
                self.tyre, self.arms, self.hub_x, *state, torque, top, brake, STEP_S, *ground, self.out, self.contact
            )
        return self.out[0]


def test_the_normal_load_follows_the_depth_and_never_pulls():
    wheel = Wheel()
    assert wheel.run(STEP_S)[2] == pytest.approx(LOAD_N)
    assert wheel.contact[0] == pytest.approx([0.0, 0.0, 0.0, LOAD_N], abs=1e-9)
    wheel.arms[0, [2, 9]] = 0.70
    assert not wheel.run(STEP_S).any()
    wheel.arms[0, [2, 9]] = wheel.loaded
    assert wheel.run(STEP_S, (0.0, 0.0, 3.0))[2] == 0.0


def test_on_a_slope_the_force_is_normal_to_it():
    wheel = Wheel(terrain=Terrain("slope"))
    force = wheel.run(STEP_S)[:3]
    direction = force / math.hypot(*force)
    assert direction == pytest.approx(wheel.terrain.normal(0.0, 0.0), abs=1e-6)


def test_a_stuck_tyre_is_a_spring_without_creep():
    wheel = Wheel()
    wheel.run(0.01, (0.0, 0.5, 0.0))
    held = [wheel.run(t)[1] for t in (1.0, 100.0)]
    assert held[0] == pytest.approx(-TYRE.tread_n_m * 0.005, rel=1e-6)
    assert held[1] == held[0]


def test_friction_is_a_circle():
    wheel = Wheel()
    force = wheel.run(1.0, (0.3, 0.4, 0.0), brake=1e6)
    assert math.hypot(force[0], force[1]) == pytest.approx(TYRE.friction * LOAD_N)
    assert force[1] / force[0] == pytest.approx(4 / 3, rel=1e-3)


def test_a_rolling_tyre_has_the_slip_stiffness_of_its_bristles():
    wheel = Wheel()
    force = wheel.run(4.0, (1.0, 0.02, 0.0))
    assert force[1] == pytest.approx(-TYRE.tread_n_m * TYRE.relaxation_m * 0.02, rel=0.02)
    assert force[0] == pytest.approx(-TYRE.rolling_resistance * LOAD_N, rel=0.02)
    assert wheel.spin[0] * wheel.loaded == pytest.approx(1.0, rel=0.01)


def test_motor_torque_becomes_pull_and_its_reaction_reaches_the_arm():
    wheel = Wheel(hub_x=1.0)
    force = wheel.run(3.0, (0.5, 0.0, 0.0), torque=2000.0, top=10.0)
    pull = 2000.0 / wheel.loaded - TYRE.rolling_resistance * LOAD_N
    assert force[0] == pytest.approx(pull, rel=0.01)
    assert force[4] == pytest.approx(-2000.0 - 1.0 * LOAD_N, rel=1e-6)  # about the pivot, 1 m behind the hub
    assert wheel.contact[0, 0] == pytest.approx(wheel.arms[0, 0] + 1.0)


def test_the_brake_holds_up_to_its_torque():
    force = Wheel().run(2.0, torque=1000.0, brake=3000.0)
    assert force[0] == pytest.approx(0.0, abs=1.0)
    slipping = Wheel()
    slipping.run(2.0, (0.3, 0.0, 0.0), brake=3000.0)
    assert slipping.out[0, 0] == pytest.approx(-3000.0 / slipping.loaded - TYRE.rolling_resistance * LOAD_N, rel=0.02)


def test_a_braked_wheel_turns_with_its_arm():
    wheel = Wheel()
    wheel.arms[0, [2, 9]] = 0.9
    wheel.arms[0, 14] = 0.2
    wheel.run(0.1, brake=3000.0)
    angle = wheel.angle[0]
    wheel.run(1.0, brake=3000.0)
    assert wheel.spin[0] == pytest.approx(0.2)
    assert wheel.angle[0] == pytest.approx(angle, abs=1e-9)


def test_a_lifted_wheel_does_not_overspeed():
    wheel = Wheel()
    wheel.arms[0, [2, 9]] = 0.9
    wheel.run(5.0, torque=5000.0, top=1.0)
    assert 1.0 < wheel.spin[0] <= 1.0 + TYRE.slip_limit * 2.0 + 1e-6
    assert not wheel.out[0, :3].any()
