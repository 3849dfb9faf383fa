"""The share that a monitor tells is 1 or more exactly when it finds a fault: separations are read from it."""

import random
from itertools import count

import pytest

from can_dbc.messages.crane import GrappleCommand
from controller.estimation.joint_estimator import NoiseMonitor
from controller.estimation.joint_monitors import DriftMonitor, MotionMonitor, StandstillMonitor
from controller.estimation.valve_monitors import SPEED_WINDOW_S, SpeedMonitor, SpoolMonitor
from machine.status.reasons import Reason
from tests.controller.bench import AORO, SPECS, Bench, T

T_S = T * 1e-9
SPEC = SPECS[1]
LIMIT = SPEC.speed_limit


def motion(rng):
    monitor, command, velocity = MotionMonitor(SPEC, T_S), 0.0, 0.0
    for k in count():
        if k % 60 == 0:
            command, velocity = rng.choice((0.0, 0.3, 1.0)) * LIMIT, rng.choice((-1.0, 0.0, 0.4, 1.0, 2.0)) * LIMIT
        yield monitor.step(command, velocity) is not Reason.NONE, max(monitor.shares())


def standstill(rng):
    monitor, position, speed = StandstillMonitor(SPEC, T_S), 0.0, 0.0
    for k in count():
        if k % 200 == 0:
            speed, shaken, pressed = rng.choice((0.0, 0.03, 0.3)) * LIMIT, rng.random() < 0.5, rng.random() < 0.3
        position += speed * T_S
        yield monitor.step(k % 900 > 20, shaken, position, 0.0, pressed), monitor.share()


def drift(rng):
    monitor, position = DriftMonitor(SPEC, T_S), 0.0
    for k in count():
        if k % 1000 == 0:
            rate = rng.choice((0.0, 0.02, 0.05)) * LIMIT
        open_ = k % 300 < 40
        position += rate * T_S if not open_ else 0.0
        yield monitor.step(not open_, -4.0 * rate if open_ else 0.0, position, True), monitor.share()


def speed(rng):
    monitor, expected, factor = SpeedMonitor(SPEC.valve, LIMIT, T_S, SPEED_WINDOW_S), 0.0, 1.0
    for k in count():
        if k % 150 == 0:
            expected, factor = rng.choice((0.0, 0.4, 0.9)) * LIMIT, rng.choice((-1.0, 0.0, 0.5, 1.0, 1.0, 1.9))
            pressed = rng.random() < 0.3
        yield monitor.step(expected, factor * expected + 0.01, pressed) is not Reason.NONE, max(monitor.shares())


def spool(rng):
    monitor, command, spool_pct = SpoolMonitor(12.0, T_S), 0.0, 0.0
    for k in count():
        if k % 120 == 0:
            command = rng.choice((0.0, 30.0, -60.0))
            spool_pct = rng.choice((command, command, 0.6 * command, -command, 0.0, 40.0))
        yield monitor.step(command, spool_pct) is not Reason.NONE, max(monitor.shares())


def noise(rng):
    encoder = SPEC.encoder
    monitor, factor = NoiseMonitor(encoder.noise, encoder.unit_per_count, 1.5, T_S), 1.0
    for k in count():
        if k % 500 == 0:
            factor = rng.choice((0.3, 1.0, 4.0, 10.0)) if k > 4000 else 0.5
        monitor.update(rng.gauss(0.0, factor * encoder.noise))
        yield monitor.noisy, monitor.share()


@pytest.mark.parametrize("watch", [motion, standstill, drift, speed, spool, noise])
def test_a_share_of_one_is_the_fault(watch):
    seen = {True: 0, False: 0}
    for seed in range(3):
        for _, (found, share) in zip(range(8000), watch(random.Random(seed)), strict=False):
            assert found is (share >= 1.0), share
            seen[found] += 1
    assert min(seen.values()) > 20, "both happen"


def test_every_monitor_of_a_machine_tells_its_share_and_a_good_one_is_far_from_its_fault():
    bench = Bench(AORO).active()
    controller = bench.controller
    shares = {}
    for _ in range(300):
        bench.tick([bench.moving(0, 0.1)])
        for j in range(len(SPECS)):
            for name, share in {**controller.joint_watch.shares(j), **controller.valve_watch.shares(j)}.items():
                shares[name] = max(share, shares.get(name, 0.0))
            shares["noise"] = max(controller.estimators[j].noise_share(), shares.get("noise", 0.0))
    assert len(shares) == 13
    assert max(shares.values()) < 0.8, shares
    bench.tick([bench.hold(grapple=GrappleCommand.CLOSE)])
    against = [("joint against its command" in controller.joint_watch.shares(j)) for j in range(len(SPECS))]
    assert against == [True, True, True, True, False], "logs between the tongs turn the rotator"
