"""The tongs: what they are told, and what the controller's report says of them, open, closed, clear of the logs.

Without a sensor they are timed.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Final

from autonomy.crane_job.inbox import Inbox
from autonomy.grasp.bunk_load import is_over_bunk
from autonomy.grasp.grapple_heights import release_angle_rad
from autonomy.grasp.grasp import Grasp
from autonomy.motion.arm import Arm
from can_dbc.messages.crane import GrappleCommand, StateReport
from machine.geometry.grapple import (
    half_gap_m,
    opening_pct_from_tong_angle,
    tip_below_pin_m,
    tong_angle_from_opening_pct,
)
from machine.profile import Bunk, Profile

_STATE_CLOSED_EMPTY, _STATE_HOLDING = 4, 5
"""Of GrappleStat.State: at the end of its way with nothing in it, and stopped by what it holds."""
_OPEN_FROM_PCT: Final = 92.0
_ASSUMED_GRIP_RAD: Final = 1.5
"""Tongs without a sensor are taken to have been closed as far when they let go of a log: past tips that meet."""
_STALLED_WIDE_PCT, _STALLED_WIDE_STEP_PCT, _STALLED_EXCESS_M = 70.0, 3.0, 0.15
"""Tongs that stop closing so wide open, or so much wider than the wood they are to hold lies side by side, clasp a
heap's sides: their tips are not under it."""
_THICK_LOG_M: Final = 0.2
"""Thinner logs are held in tongs that have shut."""
_EMPTY_ON_GROUND_KG: Final = 8.0
"""Less than the thinnest log weighs, half of it lying on others."""
_EMPTY_LIFTED_KG: Final = 12.0
"""Less than the thinnest log weighs that hangs, more than a crane at rest reads for nothing.  The controller says that
tongs hold something from 30 kg on: thin logs weigh less and vanish in tongs that have shut."""
_RELEASED_KG: Final = 30.0
"""What hangs in the tongs when they have let go, at most."""
_PUSH_LOAD_KG, _PUSH_FACTOR = 250.0, 1.5
"""Tongs that bear more after that, and so many times what hung in them, push against logs or stakes and lift the crane;
what only rebounds bears less."""
_UNDER_LOG_SHARE: Final = 0.85
"""The tips are under a log when they are nearer to each other than so much of its diameter."""
_STILL_BAND_PCT, _STILL_S = 0.5, 0.8
"""Tongs stand that move by less in this time; logs that give way are pressed together slowly."""
_MIN_CLOSING_S: Final = 0.5
"""Of closing, before the report can be of it."""
_VALVE_DELAY_S: Final = 0.4
_SLOW_OPENING_FACTOR: Final = 1.3
"""Before they move, and how much slower they may be than the profile says."""
_CLOSE_GAIN_1_S: Final = 2.0
_MAX_CLOSE_RATE: Final = 1.3


def following_rate(ahead_s: float) -> float:
    """How fast the pin follows the sweep of closing tongs that are so far ahead of it; NaN: at its own pace."""
    return min(max(1.0 + _CLOSE_GAIN_1_S * ahead_s, 0.0), _MAX_CLOSE_RATE) if isfinite(ahead_s) else 1.0


def has_closed(report: StateReport, closing_s: float) -> bool:
    """Whether they have closed, on something or nothing, ``closing_s`` after they were told to."""
    return closing_s > _MIN_CLOSING_S and report.grapple_state in (_STATE_CLOSED_EMPTY, _STATE_HOLDING)


def is_closed_empty(report: StateReport) -> bool:
    """Whether they shut on nothing, and nothing weighs in them."""
    return report.grapple_state == _STATE_CLOSED_EMPTY


def lifts_nothing(report: StateReport) -> bool:
    """Whether they shut and came up with nothing that is known to weigh."""
    return is_closed_empty(report) and not report.load_kg >= _EMPTY_LIFTED_KG


def is_open(profile: Profile, report: StateReport, opening_s: float) -> bool:
    """Whether they stand open."""
    if isfinite(report.opening_pct):
        return report.opening_pct >= _OPEN_FROM_PCT
    return opening_s > profile.grapple.open_time_s


def has_released(profile: Profile, report: StateReport, grasp: Grasp, opening_s: float) -> bool:
    """Whether they have left the logs that they held."""
    grapple = profile.grapple
    angle = release_angle_rad(profile, max(log.diameter_m for log in grasp.logs))
    if grasp.others:
        angle = 0.0  # logs beside each other reach farther out
    if isfinite(report.opening_pct):
        return report.opening_pct >= min(opening_pct_from_tong_angle(grapple.tongs, angle), _OPEN_FROM_PCT)
    turned = max(_ASSUMED_GRIP_RAD - angle, 0.0) / grapple.tongs.angle_rad[-1]
    return opening_s > _VALVE_DELAY_S + _SLOW_OPENING_FACTOR * turned * grapple.open_time_s


def is_between_stakes(arm: Arm, bunk: Bunk, q: Sequence[float]) -> bool:
    """Whether tongs that have let a log go stand so low over a bunk that to open further would stir the heap."""
    pose, top_m = arm.pose(q), bunk.floor_z_m + bunk.stake_height_m
    return is_over_bunk(bunk, *arm.xy(pose)) and pose.z_m < top_m + tip_below_pin_m(arm.profile.grapple.tongs, 0.0)


def equivalent_closing_s(profile: Profile, report: StateReport) -> float:
    """How long tongs of the nominal speed have been closing to be where they are measured; NaN if unknown."""
    opening = report.opening_pct
    if not isfinite(opening):
        return opening
    tongs = profile.grapple.tongs
    return tong_angle_from_opening_pct(tongs, opening) / tongs.angle_rad[-1] * profile.grapple.close_time_s


class GrappleSequence:
    """Those of one job.  ``command`` is what they are told now."""

    def __init__(self, profile: Profile, heard: Inbox) -> None:
        self.command = GrappleCommand.HOLD
        self._profile, self._inbox = profile, heard
        self._opening_s = self._close_from_s = self._still_s = self._since_push_s = 0.0
        self._reference_pct = self._held_kg = 0.0
        self._has_let_go = self.is_obstructed = False
        """``is_obstructed``: while opening they came to push against something; a load cell tells."""

    def release(self, dt_s: float) -> None:
        """Open, from now on for so long; once they push, back as far as they do so, and hold still."""
        gives_way = self.is_obstructed and self._is_pushing
        back = GrappleCommand.CLOSE if gives_way else GrappleCommand.NEUTRAL
        self.apply(back if self.is_obstructed else GrappleCommand.OPEN, dt_s, gives_way)

    def apply(self, command: GrappleCommand, dt_s: float, gives_way: bool = False) -> None:
        """A command, from now on for so long; ``gives_way``: not to close, but to push no longer."""
        self.command = command
        opening = self._inbox.report.opening_pct if self._inbox.report is not None else 0.0
        self._still_s += dt_s
        if abs(opening - self._reference_pct) > _STILL_BAND_PCT:
            self._reference_pct, self._still_s = opening, 0.0
        if gives_way or command in (GrappleCommand.OPEN, GrappleCommand.NEUTRAL):
            self._sense_load(dt_s)
        else:
            self._held_kg, self._has_let_go, self.is_obstructed = self._load_kg, False, False
        if command is GrappleCommand.OPEN:
            self._opening_s += dt_s
        elif command is not GrappleCommand.NEUTRAL:
            self._opening_s = 0.0

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
    def open(self) -> bool:
        """Whether they stand open."""
        return is_open(self._profile, self._inbox.report, self._opening_s)

    def is_stalled_wide(self, grasp: Grasp, climbs: int) -> bool:
        """Whether they are seen to stand too wide open to lift what they hold, gripped higher so often already, where
        there is less; without a sensor nobody knows.
        """
        wood_m = sum(log.diameter_m for log in grasp.logs)
        too_open = self._inbox.report.opening_pct > _STALLED_WIDE_PCT - _STALLED_WIDE_STEP_PCT * climbs
        return too_open or self._gap_m() > wood_m + _STALLED_EXCESS_M

    def has_missed(self, grasp: Grasp) -> bool:
        """Whether they are seen to have shut on nothing where thick logs were, or to pinch the upper half of a log that
        they were to be under; without a sensor nobody knows.
        """
        if is_closed_empty(self._inbox.report):
            return grasp.thinnest_m > _THICK_LOG_M
        return grasp.extracts and self._gap_m() > _UNDER_LOG_SHARE * grasp.thinnest_m

    @property
    def holds_nothing(self) -> bool:
        """Whether they are seen to have shut, and nothing weighs in them; without a load cell nobody knows."""
        return is_closed_empty(self._inbox.report) and self._inbox.report.load_kg < _EMPTY_ON_GROUND_KG

    def _gap_m(self) -> float:
        """Between the tips; 0 when no sensor tells."""
        opening, tongs = self._inbox.report.opening_pct, self._profile.grapple.tongs
        return 2.0 * half_gap_m(tongs, tong_angle_from_opening_pct(tongs, opening)) if isfinite(opening) else 0.0

    @property
    def empty(self) -> bool:
        """Whether they have shut on nothing that is seen."""
        return is_closed_empty(self._inbox.report)

    @property
    def is_still(self) -> bool:
        """Whether they have not moved for a while."""
        return self._still_s > _STILL_S

    def has_closed(self, closing_s: float) -> bool:
        """Whether they have closed, on something or nothing, ``closing_s`` after they were told to."""
        return has_closed(self._inbox.report, closing_s)

    def has_released(self, grasp: Grasp, opening_s: float) -> bool:
        """Whether they have left the logs of a grasp, ``opening_s`` after they were told to open there, or opened until
        they pushed against something, gave way, and the crane has swung out.
        """
        return self._since_push_s > _STILL_S if self.is_obstructed else has_released(self._profile, self._inbox.report, grasp, opening_s)

    def follow(self) -> float:
        """The pin is to follow them from now on: how long they have been closing, s; 0 where no sensor tells."""
        measured_s = equivalent_closing_s(self._profile, self._inbox.report)
        self._close_from_s = measured_s if isfinite(measured_s) else 0.0
        return self._close_from_s

    def pace(self, clock_s: float) -> float:
        """How fast the pin is to go that has followed them for so much of its motion."""
        return following_rate(equivalent_closing_s(self._profile, self._inbox.report) - self._close_from_s - clock_s)
