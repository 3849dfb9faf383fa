"""The grapple of one crane job: its commands, and what the controller's report says about it.

`GrappleSequence` decides whether the jaws are open, closed, stalled, empty or clear of the logs.  Without an opening
sensor it works by time; without a load cell it assumes that the grapple holds something.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, nan
from typing import Final

from autonomy.crane_job.inbox import Inbox
from autonomy.grasp.bunk_load import is_over_bunk
from autonomy.grasp.grapple_heights import release_angle_rad
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Arm
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.geometry.grapple import (
    half_gap_m,
    jaw_angle_from_opening_pct,
    opening_pct_from_jaw_angle,
    tip_below_pin_m,
)
from machine.profile import Bunk, Profile

_STATE_CLOSED_EMPTY, _STATE_HOLDING = 4, 5
"""Values of GrappleStat.State: closed to the end of the stroke with nothing in it; stopped by what it holds."""
_OPEN_FROM_PCT: Final = 92.0
_ASSUMED_GRIP_RAD: Final = 1.5
"""Jaw angle assumed when jaws without a sensor release a log: past the point where the tips meet."""
_STALLED_WIDE_PCT, _STALLED_EXCESS_M = 70.0, 0.15
"""Jaws that stop closing this wide open, or with a gap this much wider than their logs side by side, clasp the sides
of a pile: their tips are not under it."""
THICK_LOG_M: Final = 0.2
"""Thinner logs may be held in fully closed jaws."""
_EMPTY_ON_GROUND_KG: Final = 8.0
"""Less than the thinnest log weighs with half of it lying on others."""
_EMPTY_LIFTED_KG: Final = 12.0
"""Less than a thick hanging log weighs, more than a single reading of an empty crane.  The controller reports a held
load from 30 kg on: thin logs weigh less and vanish in fully closed jaws."""
_EMPTY_MEAN_KG, _MEAN_S = 5.0, 0.8
"""Less than the mean over this time of the thinnest hanging log: 12 kg (12 cm thick), 7 kg while the lift slows down,
of readings from 0 to 16 kg.  That of an empty crane is below 1 kg, of readings up to 6 kg."""
_UNLADEN_S: Final = 1.0
"""A hanging load swings, and its weight with it: jaws that bear nothing for longer than half a swing are empty."""
_LIVE_S: Final = 0.5
"""A load that is weighed changes within this time; one that is estimated from pressures keeps its value while the lift
speeds up."""
_RESTING_SHARE, _RESTING_S, _RESTING_FROM_KG = 0.35, 0.1, 60.0
"""A load on its way down that weighs less than this share of itself for so long rests on something.  Lighter loads
vary by as much while the crane slows down."""
_KEPT_SHARE: Final = 0.35
"""Jaws without an opening sensor that have opened and risen, and bear more than this share of their load, have taken it
along: a neighbour or a stake kept them from opening, and a tip is still under it."""
_RELEASED_KG: Final = 30.0
"""Greatest load in the jaws once they have released their logs."""
_PUSH_LOAD_KG, _PUSH_FACTOR = 250.0, 1.5
"""Jaws that afterwards bear more than this, and this many times what hung in them, push against logs or stakes and lift
the crane; a rebound bears less."""
_OPENS_AGAIN: Final = 2
"""Jaws without a sensor that gave way, and still bear their load, open again this often: a log that falls within them
as they open weighs nothing for a moment, and more than twice its weight in the next."""
_UNDER_LOG_SHARE: Final = 0.85
"""The tips are under a log when their gap is less than this share of its diameter."""
_STILL_BAND_PCT, _STILL_S = 0.5, 0.8
"""Jaws that move less than this within this time are still; logs that give way are pressed together slowly."""
_MIN_CLOSING_S: Final = 0.5
"""Time of closing before the report can reflect it."""
_VALVE_DELAY_S: Final = 0.4
_SLOW_OPENING_FACTOR: Final = 1.3
"""Delay before the jaws move, and how much slower they may be than the profile says."""
_CLOSE_GAIN_1_S: Final = 2.0
_MAX_CLOSE_RATE: Final = 1.3


def following_rate(ahead_s: float) -> float:
    """Compute the rate at which the pin follows the sweep of jaws that are ``ahead_s`` ahead of it; 1 where that is
    NaN.
    """
    return min(max(1.0 + _CLOSE_GAIN_1_S * ahead_s, 0.0), _MAX_CLOSE_RATE) if isfinite(ahead_s) else 1.0


def has_closed(report: StateReport, closing_s: float) -> bool:
    """Tell whether the jaws have closed, on something or nothing, ``closing_s`` after the command."""
    return closing_s > _MIN_CLOSING_S and report.grapple_state in (_STATE_CLOSED_EMPTY, _STATE_HOLDING)


def is_closed_empty(report: StateReport) -> bool:
    """Tell whether the jaws closed to the end of their stroke without holding anything."""
    return report.grapple_state == _STATE_CLOSED_EMPTY


def is_measured_open(report: StateReport) -> bool:
    """Tell whether the jaws are measured to be open; False without a sensor."""
    return report.opening_pct >= _OPEN_FROM_PCT


def is_open(profile: Profile, report: StateReport, opening_s: float) -> bool:
    """Tell whether the jaws are open; without a sensor, by the time since the command."""
    if isfinite(report.opening_pct):
        return is_measured_open(report)
    return opening_s > profile.grapple.open_time_s


def has_released(profile: Profile, report: StateReport, grasp: Grasp, opening_s: float) -> bool:
    """Tell whether the jaws have left the logs that they held."""
    grapple = profile.grapple
    angle = release_angle_rad(profile, max(log.diameter_m for log in grasp.logs))
    if grasp.others:
        angle = 0.0  # logs beside each other reach farther out
    if isfinite(report.opening_pct):
        return report.opening_pct >= min(opening_pct_from_jaw_angle(grapple.jaws, angle), _OPEN_FROM_PCT)
    turned = max(_ASSUMED_GRIP_RAD - angle, 0.0) / grapple.jaws.angle_rad[-1]
    return opening_s > _VALVE_DELAY_S + _SLOW_OPENING_FACTOR * turned * grapple.open_time_s


def is_between_stakes(arm: Arm, bunk: Bunk, q: Sequence[float]) -> bool:
    """Tell whether open jaws are so low over a bunk that opening them further would stir its load."""
    pose, top_m = arm.pose(q), bunk.floor_z_m + bunk.stake_height_m
    return is_over_bunk(bunk, *arm.xy(pose)) and pose.z_m < top_m + tip_below_pin_m(arm.profile.grapple.jaws, 0.0)


def equivalent_closing_s(profile: Profile, report: StateReport) -> float:
    """Tell how long jaws of nominal speed would have been closing to be where they are measured, s; NaN if unknown."""
    opening = report.opening_pct
    if not isfinite(opening):
        return opening
    jaws = profile.grapple.jaws
    return jaw_angle_from_opening_pct(jaws, opening) / jaws.angle_rad[-1] * profile.grapple.close_time_s


class GrappleSequence:
    """Commands and state of the grapple during one job; ``command`` is the present command."""

    def __init__(self, profile: Profile, inbox: Inbox) -> None:
        self.command = GrappleCommand.HOLD
        self._profile, self._inbox = profile, inbox
        self._opening_s = self._close_from_s = self._still_s = self._since_push_s = 0.0
        self._reference_pct = self._held_kg = self._unladen_s = self._same_s = self._weighed_kg = 0.0
        self._mean_kg = nan
        self.laden_kg = self._resting_s = 0.0
        """``laden_kg``: what hung in the jaws when the crane set out for the place."""
        self._again_count = 0
        self._has_let_go = self.is_obstructed = False
        """Whether the opening jaws push against something; only a load cell tells."""

    def release(self, dt_s: float) -> None:
        """Open for one tick of ``dt_s``; jaws that push close until they no longer do, and then hold still."""
        if self._opens_again:
            self._again_count += 1
            self._opening_s, self._has_let_go, self.is_obstructed = 0.0, False, False
        gives_way = self.is_obstructed and self._is_pushing
        back = GrappleCommand.CLOSE if gives_way else GrappleCommand.NEUTRAL
        self.apply(back if self.is_obstructed else GrappleCommand.OPEN, dt_s, gives_way)

    def apply(self, command: GrappleCommand, dt_s: float, gives_way: bool = False) -> None:
        """Apply a command for one tick of ``dt_s``; ``gives_way``: it closes only to stop pushing."""
        self.command = command
        opening = self._inbox.report.opening_pct if self._inbox.report is not None else 0.0
        self._still_s += dt_s
        self._weigh(dt_s)
        if abs(opening - self._reference_pct) > _STILL_BAND_PCT:
            self._reference_pct, self._still_s = opening, 0.0
        if gives_way or command in (GrappleCommand.OPEN, GrappleCommand.NEUTRAL):
            self._sense_load(dt_s)
        else:
            self._held_kg, self._has_let_go, self.is_obstructed, self._again_count = self._load_kg, False, False, 0
        if command is GrappleCommand.OPEN:
            self._opening_s += dt_s
        elif command is not GrappleCommand.NEUTRAL:
            self._opening_s = 0.0

    def _weigh(self, dt_s: float) -> None:
        """Take the mean, and count how long a live reading has been that of empty jaws."""
        before, self._weighed_kg = self._weighed_kg, self._load_kg
        mean_kg = self._mean_kg if isfinite(self._mean_kg) else self._weighed_kg
        self._mean_kg = mean_kg + min(dt_s / _MEAN_S, 1.0) * (self._weighed_kg - mean_kg)
        self._same_s = self._same_s + dt_s if before == self._weighed_kg else 0.0
        resting = self._weighed_kg < _RESTING_SHARE * self.laden_kg
        self._resting_s = self._resting_s + dt_s if resting else 0.0
        nothing = self._weighed_kg < _EMPTY_LIFTED_KG and self._same_s < _LIVE_S
        self._unladen_s = self._unladen_s + dt_s if nothing else 0.0

    def _sense_load(self, dt_s: float) -> None:
        self._has_let_go |= self._load_kg < _RELEASED_KG
        self.is_obstructed |= self._has_let_go and self._is_pushing
        self._since_push_s = 0.0 if self._is_pushing else self._since_push_s + dt_s

    @property
    def _load_kg(self) -> float:
        return self._inbox.report.load_kg if self._inbox.report is not None else 0.0

    @property
    def _is_pushing(self) -> bool:
        return self._load_kg > max(_PUSH_LOAD_KG, _PUSH_FACTOR * self._held_kg)

    @property
    def is_open(self) -> bool:
        """Whether the jaws are open."""
        return is_open(self._profile, self._inbox.report, self._opening_s)

    def is_stalled_wide(self, grasp: Grasp) -> bool:
        """Tell whether the jaws are measured too wide open to be under what they hold; False without a sensor."""
        wood_m = sum(log.diameter_m for log in grasp.logs)
        return self._inbox.report.opening_pct > _STALLED_WIDE_PCT or self._gap_m() > wood_m + _STALLED_EXCESS_M

    def has_missed(self, grasp: Grasp) -> bool:
        """Tell whether the jaws are measured to have closed on nothing where thick logs were, or to pinch the upper
        half of a log whose underside they should reach; False without a sensor.  What a load cell weighs was not
        missed: a log may be thinner than it was measured.
        """
        if is_closed_empty(self._inbox.report):
            return grasp.thinnest_m > THICK_LOG_M and self.lifts_nothing
        return grasp.extracts and self._gap_m() > _UNDER_LOG_SHARE * grasp.thinnest_m

    def has_lost(self, grasp: Grasp) -> bool:
        """Tell whether nothing has been weighed for a while although thick logs should hang in the jaws; False where
        the load is not known.
        """
        return grasp.thinnest_m > THICK_LOG_M and self._unladen_s > _UNLADEN_S

    @property
    def load_rests(self) -> bool:
        """Whether something else bears the load; False where the load is light or not known."""
        return self.laden_kg > _RESTING_FROM_KG and self._resting_s > _RESTING_S

    @property
    def opens_unseen(self) -> bool:
        """Whether no sensor tells how far the jaws have opened."""
        return not isfinite(self._inbox.report.opening_pct)

    @property
    def may_keep_load(self) -> bool:
        """Whether only the load cell can tell that the jaws have released it: they have no sensor, and it is heavy."""
        return self.opens_unseen and self.laden_kg > _RESTING_FROM_KG

    @property
    def has_kept_load(self) -> bool:
        """Whether opened jaws that have risen still bear a good part of the load."""
        return self._bears_load(self._mean_kg)

    def _bears_load(self, kg: float) -> bool:
        return kg > max(_RELEASED_KG, _KEPT_SHARE * self.laden_kg)

    @property
    def _opens_again(self) -> bool:
        """Whether jaws that gave way and are at rest shall open again: only the load cell tells, and reads a load."""
        stopped = self.is_obstructed and self._since_push_s > _STILL_S and self._again_count < _OPENS_AGAIN
        return stopped and self.may_keep_load and self.has_kept_load and self._bears_load(self._load_kg)

    @property
    def lifts_nothing(self) -> bool:
        """Whether the jaws closed fully and came up with no known load."""
        return is_closed_empty(self._inbox.report) and not self._mean_kg >= _EMPTY_MEAN_KG

    @property
    def holds_nothing(self) -> bool:
        """Whether the jaws have closed fully and the load cell reads nothing, now and on average; False without a load
        cell.  The weight of a thin log that swings is nothing at times.
        """
        return self.lifts_nothing and self._inbox.report.load_kg < _EMPTY_ON_GROUND_KG

    def _gap_m(self) -> float:
        """Compute the gap between the tips, m; 0 without a sensor."""
        opening, jaws = self._inbox.report.opening_pct, self._profile.grapple.jaws
        return 2.0 * half_gap_m(jaws, jaw_angle_from_opening_pct(jaws, opening)) if isfinite(opening) else 0.0

    @property
    def empty(self) -> bool:
        """Whether the jaws have closed fully without holding anything."""
        return is_closed_empty(self._inbox.report)

    @property
    def is_still(self) -> bool:
        """Whether the jaws have not moved for a while."""
        return self._still_s > _STILL_S

    def has_closed(self, closing_s: float) -> bool:
        """Tell whether the jaws have closed, on something or nothing, ``closing_s`` after the command."""
        return has_closed(self._inbox.report, closing_s)

    def has_released(self, grasp: Grasp, opening_s: float) -> bool:
        """Tell whether the jaws have left the logs of a grasp, ``opening_s`` after the command to open, or have opened
        until they pushed against something, given way, and the crane has swung out.
        """
        if self.is_obstructed:
            return self._since_push_s > _STILL_S and not self._opens_again and not self._encloses(grasp)
        opening_s = self._opening_s if self._again_count else opening_s
        return has_released(self._profile, self._inbox.report, grasp, opening_s)

    def must_open_higher(self, grasp: Grasp) -> bool:
        """Tell whether jaws that gave way, and are at rest, still enclose the log: risen, they would take it along."""
        return self.is_obstructed and self._since_push_s > _STILL_S and self._encloses(grasp)

    def _encloses(self, grasp: Grasp) -> bool:
        """Tell whether the jaws are measured too far closed to leave the log of a grasp behind; the logs of a bundle
        roll out of jaws that are half open.
        """
        report = self._inbox.report
        return isfinite(report.opening_pct) and not grasp.others and not has_released(self._profile, report, grasp, 0.0)

    def start_following(self) -> float:
        """Let the pin follow the jaws from now on: return how long they have been closing, s; 0 without a sensor."""
        measured_s = equivalent_closing_s(self._profile, self._inbox.report)
        self._close_from_s = measured_s if isfinite(measured_s) else 0.0
        return self._close_from_s

    def following_rate(self, clock_s: float) -> float:
        """Return the rate at which the pin's motion goes on after ``clock_s`` of it."""
        return following_rate(equivalent_closing_s(self._profile, self._inbox.report) - self._close_from_s - clock_s)
