"""The guard's checks of the carrier: its commands on mach0, and whether the machine does what they say.

A command's own fields are checked when it arrives, its effect in every step.  Crane and carrier move one at a time
(docs/architecture.md, "Driving"): above `CREEP_M_S` the crane may only be held in place.
"""

from __future__ import annotations

from typing import Final

from controller.guard.envelope import CarrierLimits
from controller.guard.joints import RateCredit
from controller.guard.layout import Field, Layout
from controller.guard.stream import WatchedMessage
from controller.guard.verdicts import ARMS_AXIS, DRIVE_AXIS, FINE, NO_AXIS, STEER_AXIS, Finding, Verdict

MESSAGES: Final = ("VehCmd", "ArmCmdA", "ArmCmdB", "VehStat", "GuardAlive")
COMMAND_NS: Final = 20_000_000
ARM_KEY: Final = 0xA
CREEP_M_S: Final = 0.1
MOVES_M_S: Final = 0.15
"""A carrier that is to stand moves above this speed: the node says 0.02 m/s at rest, an outlier of a wheel more."""
STOPPING_NS: Final = 1_500_000_000
"""... for longer than this: its brake stops it from full speed in less than a second."""
BOTH_NS: Final = 300_000_000
"""Crane and carrier may overlap for the ramp of a stop."""
BEND_MARGIN_RAD: Final = 0.02
"""Inside the hard stops, which begin 0.03 rad past the limit; the controller commands nothing outward at the limit."""
RATE_FACTOR: Final = 3.0
"""A speed command may grow this many times faster than the carrier accelerates."""
_TOLERANCE: Final = 1.001  # the rounding of a signal


class Carrier:
    """The watched messages of mach0 and what they command; `receive` judges a command, `check` the machine."""

    __slots__ = (
        "_apart_ns", "_arms", "_articulation", "_brake", "_credit", "_limits", "_measured", "_obeyed_ns", "_rate",
        "_speed", "arms_a", "arms_b", "commands", "drive", "state",
    )  # fmt: skip

    def __init__(self, limits: CarrierLimits, layouts: dict[str, Layout]) -> None:
        lost = Verdict.STALE, Verdict.CORRUPT
        self.drive, self.arms_a, self.arms_b = (WatchedMessage(layouts[name], *lost) for name in MESSAGES[:3])
        self.state = WatchedMessage(layouts["VehStat"])
        self.commands = (self.drive, self.arms_a, self.arms_b)
        fields, state = layouts["VehCmd"].fields, layouts["VehStat"].fields
        self._speed, self._rate, self._brake = fields["Speed"], fields["ArticRate"], fields["Brake"]
        self._measured, self._articulation = state["Speed"], state["Articulation"]
        self._arms = [layouts["ArmCmdA"].fields[f"Arm{i}"] for i in (1, 2, 3, 4)]
        self._limits = limits
        self._credit = RateCredit(100.0 * RATE_FACTOR * limits.drive_acceleration_m_s2 / limits.speed_limit_m_s)
        self._obeyed_ns = self._apart_ns = 0

    def receive(self, watch: WatchedMessage, elapsed_s: float) -> Finding:
        """Check the fields of a command that came ``elapsed_s`` after the last one."""
        limits, word = self._limits, watch.word
        if watch is self.arms_b:
            floats = watch.raw("FloatFront"), watch.raw("FloatRear")
            return FINE if floats in ((0, 0), (0, 1), (1, 0)) else (Verdict.RANGE, ARMS_AXIS)
        if watch is self.arms_a:
            inside = all(field.inside(field.raw(word)) for field in self._arms)
            return FINE if inside else (Verdict.RANGE, ARMS_AXIS)
        speed_m_s = self._value(self._speed, watch)
        if abs(speed_m_s) > limits.speed_limit_m_s * _TOLERANCE or not self._brake.inside(self._brake.raw(word)):
            return Verdict.RANGE, DRIVE_AXIS
        if abs(self._value(self._rate, watch)) > limits.articulation_rate_limit_rad_s * _TOLERANCE:
            return Verdict.RANGE, STEER_AXIS
        spent = self._credit.spent(100.0 * speed_m_s / limits.speed_limit_m_s, elapsed_s)
        return (Verdict.RATE, DRIVE_AXIS) if spent else FINE

    def _value(self, field: Field, watch: WatchedMessage) -> float:
        return field.raw(watch.word) * field.scale

    @property
    def driven(self) -> bool:
        """Whether a motion of the wheels or the articulation is commanded; a released brake lets the wheels roll."""
        drive = self.drive
        return any(field.raw(drive.word) for field in (self._speed, self._rate)) or self._brake.raw(drive.word) == 0

    @property
    def raised(self) -> list[WatchedMessage]:
        """The messages that command a swing arm or a float valve."""
        floats = bool(self.arms_b.raw("FloatFront") or self.arms_b.raw("FloatRear"))
        return [self.arms_a] * any(field.raw(self.arms_a.word) for field in self._arms) + [self.arms_b] * floats

    def check(self, crane_moves: bool, now_ns: int) -> Finding:
        """Check the rules on the present state of commands and machine."""
        drive, lost = self.drive, self.state.old(now_ns)
        measured_m_s = 0.0 if lost else self._value(self._measured, self.state)
        old = [watch.old(now_ns) for watch in self.commands]  # each of them, for it resets its stream
        armed = not any(old) and drive.raw("ArmKey") == ARM_KEY
        if (armed and self._brake.raw(drive.word) == 0) or abs(measured_m_s) <= MOVES_M_S:
            self._obeyed_ns = now_ns
        if now_ns - self._obeyed_ns > STOPPING_NS:
            return Verdict.MOVING, DRIVE_AXIS
        if any(old):
            return Verdict.NO_COMMAND, NO_AXIS
        driven, raised = self.driven, self.raised
        if driven and not armed:
            return Verdict.NOT_ARMED, DRIVE_AXIS
        # Each message by its own key: a step may fall between the two, and the node moves only while both are armed.
        if any(watch.raw("ArmKey") != ARM_KEY for watch in raised):
            return Verdict.NOT_ARMED, ARMS_AXIS
        speed_m_s = self._value(self._speed, drive)
        if not crane_moves or max(abs(speed_m_s), abs(measured_m_s)) <= CREEP_M_S:
            self._apart_ns = now_ns
        if now_ns - self._apart_ns > BOTH_NS:
            return Verdict.BOTH, DRIVE_AXIS
        if not (driven or raised):
            return FINE
        known = self._measured.inside(self._measured.raw(self.state.word))
        if lost or not known or not self._articulation.inside(self._articulation.raw(self.state.word)):
            return Verdict.CARRIER_LOST, DRIVE_AXIS
        bend_rad, rate_rad_s = self._value(self._articulation, self.state), self._value(self._rate, drive)
        outward = abs(bend_rad) > self._limits.articulation_limit_rad + BEND_MARGIN_RAD and bend_rad * rate_rad_s > 0.0
        return (Verdict.OUTSIDE, STEER_AXIS) if outward else FINE
