"""Datagrams from a motion: a window with a lease, final at its end; and the clock of the motion that they follow."""

from __future__ import annotations

import pytest

from autonomy.crane_job.trajectory_tracker import BRAKE_S, TrajectoryTracker
from autonomy.motion.setpoint_stream import HORIZON_KNOT_COUNT, PERIOD_NS, SetpointStream
from autonomy.motion.trajectory import hold
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramFault, DatagramRefused
from machine.loading.profile_file import load_profile


class Ramp:
    """All axes at 0.1 per second for two seconds."""

    duration_s = 2.0

    def at(self, time_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        inside = 0.0 < time_s < self.duration_s
        return (0.1 * min(max(time_s, 0.0), self.duration_s),) * 5, (0.1 if inside else 0.0,) * 5


def window(time_s: float, rate: float = 1.0, now_ns: int = 7_000_000_000) -> CraneSetpoint:
    stream = SetpointStream(0xABCD, 150_000_000)
    message = decode(stream.datagram(now_ns, Ramp(), time_s, GrappleCommand.HOLD, rate))
    assert isinstance(message, CraneSetpoint)
    return message


def test_the_window_shows_the_next_400_ms() -> None:
    setpoint = window(0.5)
    assert [k.after_ns for k in setpoint.knots] == [n * PERIOD_NS for n in range(HORIZON_KNOT_COUNT + 1)]
    assert [k.position[0] for k in setpoint.knots] == pytest.approx([0.05 + 0.005 * n for n in range(9)])
    assert all(k.velocity == pytest.approx((0.1,) * 5) for k in setpoint.knots)
    assert (setpoint.profile_hash, setpoint.lease_ns, setpoint.stamp_ns) == (0xABCD, 150_000_000, 7_000_000_000)
    assert setpoint.grapple is GrappleCommand.HOLD and not setpoint.final


def test_a_slower_clock_slows_positions_and_velocities() -> None:
    setpoint = window(0.5, rate=0.5)
    assert [k.position[0] for k in setpoint.knots] == pytest.approx([0.05 + 0.0025 * n for n in range(9)])
    assert setpoint.knots[3].velocity == pytest.approx((0.05,) * 5)


@pytest.mark.parametrize(("time_s", "final"), [(1.55, False), (1.65, True), (2.5, True)])
def test_final_says_that_the_end_is_in_the_window(time_s: float, final: bool) -> None:
    setpoint = window(time_s)
    assert setpoint.final is final
    assert not final or (setpoint.knots[-1].velocity == (0.0,) * 5 and setpoint.knots[-1].position[0] == 0.2)


def test_a_hold_is_one_pose_and_final() -> None:
    q = (0.1, 0.2, -1.0, 0.5, 0.3)
    data = SetpointStream(1, 100_000_000).datagram(1_000_000_000, hold(q), 0.0, GrappleCommand.OPEN)
    setpoint = decode(data)
    assert isinstance(setpoint, CraneSetpoint) and setpoint.final
    assert all(k.position == q and k.velocity == (0.0,) * 5 for k in setpoint.knots)


def test_a_motion_that_stops_on_its_path_is_a_hold_and_final() -> None:
    setpoint = window(0.5, rate=0.0)
    assert setpoint.final
    assert all(k.position[0] == pytest.approx(0.05) and k.velocity == (0.0,) * 5 for k in setpoint.knots)


def test_sequences_rise_by_one_and_a_restart_continues_above() -> None:
    def sequences(start_ns: int) -> list[int]:
        stream = SetpointStream(1, 100_000_000)
        out = []
        for n in range(20):
            message = decode(stream.datagram(start_ns + n * PERIOD_NS, Ramp(), 0.0, GrappleCommand.OPEN))
            out.append(message.sequence)
        return out

    first, second = sequences(5_000_000_000), sequences(6_000_000_000)
    assert first == list(range(5000, 5020)) and second[0] > first[-1]


def test_with_a_key_the_datagrams_are_authenticated() -> None:
    data = SetpointStream(1, 100_000_000, b"key").datagram(10, Ramp(), 0.0, GrappleCommand.OPEN)
    assert isinstance(decode(data, b"key"), CraneSetpoint)
    with pytest.raises(DatagramRefused) as refused:
        decode(data, b"other")
    assert refused.value.fault is DatagramFault.AUTHENTICATION


# -- the clock of a tracked motion
LOADER = load_profile("palms_471")
HOME = (0.0, 1.0, -1.8, 0.5, 0.0)


@pytest.mark.parametrize("steps", [1, 5, 7])
def test_while_it_brakes_every_datagram_begins_where_the_last_one_has_led(steps: int) -> None:
    """Steps of the planner for each datagram of 50 ms: the controller goes on at the rate that was announced."""
    tracker, step_s = TrajectoryTracker(LOADER, HOME), 0.05 / steps
    tracker.begin(hold(HOME))
    at_s = tracker.clock_s
    for period in range(60):
        assert tracker.clock_s == pytest.approx(at_s, abs=1e-12)
        at_s += 0.05 * tracker.announce()
        for _ in range(steps):
            tracker.advance(step_s, 1.0 if period < 20 else 0.0, HOME)
    assert tracker.is_stopped and at_s == pytest.approx(20 * 0.05 + BRAKE_S / 2, abs=0.05)


def test_a_clock_stands_until_its_motion_is_announced() -> None:
    tracker = TrajectoryTracker(LOADER, HOME)
    tracker.begin(hold(HOME))
    tracker.advance(0.04, 1.0, HOME)
    assert tracker.clock_s == 0.0 and not tracker.is_stopped
    assert tracker.announce() == 1.0
    tracker.advance(0.04, 1.0, HOME)
    assert tracker.clock_s == pytest.approx(0.04)
