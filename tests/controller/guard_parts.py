"""Parts of the guard for tests of their limits: one axis with its encoder and command, and a joint that rests."""

from __future__ import annotations

from controller.guard.envelope import Axis
from controller.guard.joints import MotionWatch
from controller.guard.layout import Field, Layout
from controller.guard.verdicts import FINE
from tests.controller.bench import MS

AXIS = Axis(
    number=1,
    signal="Lift",
    sign=-1,
    deadbands_pct=(10.0, 20.0),
    full_speeds=(0.2, 0.4),
    rate_pct_s=100.0,
    closing_ns=50 * MS,
    lower=-1.0,
    upper=1.0,
    speed_limit=0.2,
    message="EncLift",
    total_counts=16384,
    zero_counts=8192,
    unit=-0.001,
)
PERCENT = Field(0, 16, True, 0.1, -100.0, 100.0)
POSITION = {"Position": Field(0, 16, False, 1.0, 0.0, 65535.0), "TimeStamp": Field(16, 16, False, 1.0, 0.0, 65535.0)}
ENCODER = Layout(0x181, 4, POSITION, b"", 0)


class Joint:
    """A measured joint that the test moves."""

    def __init__(self) -> None:
        self.axis, self.position, self.quiet = AXIS, 0.0, False

    def silent(self, _now_ns: int) -> bool:
        return self.quiet


def spool(percent: float) -> int:
    return round(percent * 10.0) & 0xFFFF


def resting(number: int = 1) -> tuple[MotionWatch, Joint]:
    joint = Joint()
    watch = MotionWatch(number, PERCENT, 12.0, 50 * MS, joint)  # type: ignore[arg-type]
    assert watch.check(1.0, None, 1000 * MS, 0.005) is FINE
    assert watch.check(0.0, None, 1500 * MS, 0.005) is FINE
    return watch, joint


# tables of a profile and its envelope
VALVE = {
    "signal": "Tilt",
    "deadband_plus_pct": 12.0,
    "deadband_minus_pct": 7.0,
    "full_speed_plus": 0.5,
    "full_speed_minus": 0.25,
    "delay_s": 0.2,
    "lag_s": 0.0,
    "sign": 1,
}
AXIS_LIMITS = {"acceleration_limit": 0.5, "lower": -1.0, "upper": 2.0, "speed_limit": 0.2}
