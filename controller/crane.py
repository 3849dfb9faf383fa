"""The crane as one part of the controller: what it is asked for, its lease, its laws and the spools they give.

A setpoint is a short trajectory or a spool test; either is obeyed until its lease is over.  Outputs are ``commands``
(joint velocities), ``spools`` and the grapple's command.  The mode is the supervisor's: here is only what to do in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from can_dbc.setpoint import CraneSetpoint, GrappleCommand, SpoolTest
from controller.config import Settings
from controller.estimator import JointEstimator
from controller.follower import Follower
from controller.inputs import Received
from controller.laws.crane import LOADS, CraneLaw
from controller.laws.grapple import GrappleLaw
from controller.laws.joint import STANDING
from controller.laws.sway import STATUS_USABLE, SWING, Sway
from controller.message_state import known
from controller.requests import Gate, Refused
from controller.spool_test import Refusal, SpoolRun
from machine.joints import JOINTS, N_JOINTS, Joint
from machine.reasons import Reason

IN_PLACE: Final = 0.005
"""A setpoint that stays within this of the reference [rad, m] and has no velocity holds the crane in place."""


class Crane:
    """All state of the crane's motion, built once; ``leased`` while it has something to obey."""

    __slots__ = (
        "_estimators", "_final", "_gate", "_grapple_wanted", "_load_slots", "_loads_bar", "_opening_sensed",
        "_received", "_sensed", "commands", "follower", "grapple", "law", "lease_end_ns", "leased", "spool_run",
        "spools", "sway",
    )  # fmt: skip

    def __init__(
        self, settings: Settings, received: Received, estimators: Sequence[JointEstimator], gate: Gate
    ) -> None:
        profile = settings.profile
        self._received, self._estimators, self._gate = received, estimators, gate
        self._opening_sensed = profile.grapple.opening_sensor
        self._sensed = [profile.joints[j.name.lower()].encoder is not None for j in JOINTS]
        self.law = CraneLaw(profile, settings.period_ns * 1e-9)
        leads_ns = [law.lead_ns for law in self.law.laws]
        self.follower = Follower(profile, self.law.valves, leads_ns)
        self.sway = None if profile.imu is None else Sway(profile, profile.imu, leads_ns)
        """Damps the grapple's swing on a machine that measures it."""
        self.grapple = GrappleLaw(profile.grapple)
        self.spool_run = SpoolRun(profile)
        pressures = {name: slot for slot in received.pressures for name in slot.codec.index}
        self._load_slots = tuple(pair and (pressures[pair[0]], *pair) for pair in LOADS)
        self._loads_bar = [math.nan] * N_JOINTS
        self.commands = self.law.commands
        """Joint velocities commanded in this tick."""
        self.spools = [0.0] * N_JOINTS
        self.leased = False
        self.lease_end_ns = 0
        self._final = False
        self._grapple_wanted = GrappleCommand.NEUTRAL

    # -- what it is asked for

    def refer(self, active: bool, cap: float, now_ns: int) -> None:
        """The reference of this tick: the trajectory while it obeys one; else, and in a spool test, where it is."""
        follower = self.follower
        if active and self.leased and not self.spool_run.running:
            follower.follow(now_ns, cap)
            return
        for j, estimator in enumerate(self._estimators):
            known_here = estimator.known or self._sensed[j]
            follower.hold(j, estimator.position if known_here else follower.reference[j], now_ns)

    def holds(self, setpoint: CraneSetpoint) -> bool:
        """Whether a setpoint only keeps the crane where it is."""
        reference = self.follower.reference
        for knot in setpoint.knots:
            for j in JOINTS:
                if knot.velocity[j] != 0.0 or abs(knot.position[j] - reference[j]) > IN_PLACE:
                    return False
        return True

    def moves(self, now_ns: int) -> bool:
        """Whether it is on its way."""
        return self.leased and (self.spool_run.running or not self.follower.at_rest(now_ns))

    def take(self, setpoint: CraneSetpoint, now_ns: int) -> bool:
        """Obeys a trajectory from here on, raises Refused; True when a spool test ended with it."""
        if self.spool_run.opened(now_ns):
            raise Refused(Reason.TEST_BUSY, self.spool_run.function)
        self.follower.take(now_ns, self._joins(setpoint, now_ns))
        self.lease_end_ns = setpoint.stamp_ns + setpoint.lease_ns
        self._final = setpoint.final
        self._grapple_wanted = setpoint.grapple
        tested = self.spool_run.running
        self.spool_run.end()
        return tested

    def _joins(self, setpoint: CraneSetpoint, now_ns: int) -> bool:
        """Judges a setpoint: True when it continues the plan, False when it begins where the crane is now.

        The two are the same unless the trajectory's time is behind the planner's.
        """
        gate, follower = self._gate, self.follower
        if follower.behind_ns:
            try:
                gate.check_motion(setpoint, follower.candidate, *follower.planned(now_ns), now_ns)
                return True
            except Refused as refused:
                if refused.reason is not Reason.REFERENCE_JUMP:
                    raise
        gate.check_motion(setpoint, follower.candidate, follower.reference, follower.velocity, now_ns)
        return False

    def take_test(self, test: SpoolTest, now_ns: int) -> None:
        """Obeys a spool test from here on; raises Refused."""
        if self.leased and not self.spool_run.running and not self.follower.at_rest(now_ns):
            raise Refused(Reason.TEST_BUSY, test.function)
        try:
            self.spool_run.take(test, now_ns)
        except Refusal as refusal:
            raise Refused(refusal.reason, test.function) from None
        self._gate.note_order(test)
        self.lease_end_ns = test.stamp_ns + test.lease_ns
        self._grapple_wanted = GrappleCommand.NEUTRAL

    def begin(self) -> None:
        """The laws take over, from neutral valves."""
        self.law.reset()
        if self.sway is not None:
            self.sway.reset()

    def over(self, now_ns: int) -> bool:
        """Whether the setpoint no longer says what to do: its time is over, or its last knot still moves."""
        if now_ns >= self.lease_end_ns:
            return True
        if self.spool_run.running:
            return self.spool_run.cut_short(now_ns)
        return self.follower.over(now_ns)

    def finished(self, now_ns: int) -> bool:
        """Whether what was asked for is done, so that the lease may run out in peace."""
        if self.spool_run.running:
            return self.spool_run.ends_neutral(now_ns)
        return self._final and self.follower.at_rest(now_ns)

    # -- what it does

    def control(self, active: bool, ramp_share: float, ramping: bool, cap: float, now_ns: int, elapsed_ns: int) -> None:
        """The laws while ``active``; the last command fading with ``ramp_share`` while a stop's ramp runs; else
        neutral.
        """
        self.leased &= active
        if self.spool_run.running:
            self._test(ramp_share if not active else 1.0, now_ns)
            if not active and not ramping:
                self.spool_run.end()
            return
        law, follower, received = self.law, self.follower, self._received
        if self.leased:
            loads = self._loads_bar
            for j, source in enumerate(self._load_slots):
                if source is not None:
                    slot, push, against = source
                    loads[j] = law.load_bar(j, slot.get(push), slot.get(against))
            elapsed_s = elapsed_ns * 1e-9
            if self.sway is not None:
                self._damp(self.sway, now_ns, elapsed_s)
            law.step(
                follower.reference, follower.velocity, follower.ahead, self._estimators, loads, cap, elapsed_s,
                self.sway,
            )  # fmt: skip
            clamp, release = received.grapple.get("ClampPress"), received.pressures[2].get("GrappleB")
            self.grapple.step(self._grapple_wanted, known(clamp), self.opening_pct(), known(release), now_ns)
        else:
            law.fade(ramp_share)
            self.grapple.release()
        for j, valve in enumerate(law.valves):
            self.spools[j] = valve.spool_pct(self.commands[j])

    def _damp(self, sway: Sway, now_ns: int, elapsed_s: float) -> None:
        """What the grapple's swing asks of the joints, once the crane's reference stands."""
        slot, follower = self._received.imu, self.follower
        swing, age_s = None, 0.0
        if slot is not None and slot.get("Status") in STATUS_USABLE:
            lean = tuple(slot.get(name) for name in SWING)
            if None not in lean:
                swing, age_s = lean, (now_ns - slot.stamp_ns) * 1e-9
        stands = all(abs(v) < STANDING for v in (*follower.velocity[: Joint.ROT], *follower.ahead[: Joint.ROT]))
        sway.step(swing, age_s, stands, [e.position for e in self._estimators], elapsed_s)

    def _test(self, share: float, now_ns: int) -> None:
        """One function by its spool command, every other one neutral; after a stop the ``share`` that is left of it."""
        run = self.spool_run
        for j in JOINTS:
            self.commands[j] = self.spools[j] = 0.0
        self.spools[run.function], self.commands[run.function] = run.drive(share, now_ns)
        self.grapple.release()

    def opening_pct(self) -> float:
        """The measured opening; NaN on a machine that has no sensor for it, whatever the bus says."""
        return known(self._received.grapple.get("Opening")) if self._opening_sensed else math.nan
