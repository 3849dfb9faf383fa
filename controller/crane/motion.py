"""The crane as one part of the controller: accepted requests, their lease, the laws, and the spool commands.

Inputs: accepted setpoints and spool tests, received values, joint estimates.  Outputs of a tick: ``commands`` (joint
velocities [rad/s, m/s]), ``spools_pct`` and the grapple's command.  A setpoint is a short trajectory or a spool test;
it is in force until its lease ends.  The mode belongs to the supervisor; this part only acts on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, SpoolTest
from controller.bus_io import PeriodicTimer, Signal, or_nan
from controller.config import Settings
from controller.crane.inputs import CraneInputs
from controller.crane.load import LoadChange, LoadEstimator, LoadMoment
from controller.crane.reference_governor import ReferenceGovernor
from controller.crane.spool_test_run import STOP_S, SpoolTestRun
from controller.crane.trajectory_check import TrajectoryCheck, WorkspaceCheck
from controller.estimation.joint_estimator import JointEstimator
from controller.estimation.pressure_monitor import PressureMonitor
from controller.laws.crane import LOADS, CraneLaw
from controller.laws.grapple import GrappleLaw
from controller.laws.joint import STANDING_UNIT_S
from controller.laws.sway import STATUS_USABLE, SWING, SwayDamping
from controller.requests import RequestGate, RequestRefused
from machine.joints import JOINTS, N_JOINTS, Joint
from machine.status.reasons import Reason

PLACE_PERIOD_NS: Final = 1_000_000_000
"""The place of a crane without a lease is noted anew this often."""
BORNE_TOLERANCE_M: Final = 0.1
"""From where the load became too much the pin may go outward by this in all: by braking, or on a way down that is not
plumb."""
IN_PLACE_UNITS: Final = 0.005
"""A setpoint within this of the reference [rad, m] and without velocity keeps the crane in place."""
LOAD_PERIOD_NS: Final = 20_000_000
"""The load is estimated this often, in step with the state report."""
PUSHED_BAR: Final = 40.0
"""Pressure across the slew's motor: braking a log gives 20 bar, tongs that open between a stake and a pile gave 143."""
_SLEW: Final = int(Joint.SLEW)


class Crane:
    """All state of the crane's motion, built once; ``leased`` while a setpoint or a spool test is in force."""

    __slots__ = (
        "_ahead",
        "_borne",
        "_check",
        "_estimators",
        "_final",
        "_gate",
        "_grapple_request",
        "_inputs",
        "_lift_a",
        "_lift_b",
        "_load",
        "_load_change",
        "_load_due",
        "_load_updated",
        "_loads_bar",
        "_measured",
        "_noted_ns",
        "_opening_sensed",
        "_pressure_pairs",
        "_sensed",
        "_stowed",
        "_workspace",
        "commands",
        "governor",
        "grapple",
        "law",
        "lease_end_ns",
        "leased",
        "load_kg",
        "load_moment",
        "pitch_rad",
        "pressure_monitor",
        "roll_rad",
        "spool_run",
        "spools_pct",
        "sway",
    )

    def __init__(
        self, settings: Settings, inputs: CraneInputs, estimators: Sequence[JointEstimator], gate: RequestGate
    ) -> None:
        profile = settings.profile
        self._inputs, self._estimators, self._gate = inputs, estimators, gate
        self._check, self._workspace = TrajectoryCheck(profile), WorkspaceCheck(profile)
        self._opening_sensed = profile.grapple.opening_sensor
        self._sensed = [profile.joints[j.name.lower()].encoder is not None for j in JOINTS]
        self.law = CraneLaw(profile, settings.period_ns * 1e-9)
        leads_ns = [law.lead_ns for law in self.law.laws]
        self.governor = ReferenceGovernor(profile, self.law.valves, leads_ns)
        self.sway = None if profile.imu is None else SwayDamping(profile, profile.imu, leads_ns)
        """Damps the grapple's swing on a machine with an inertial sensor on the grapple."""
        self.grapple = GrappleLaw(profile.grapple)
        self.spool_run = SpoolTestRun(profile)
        pressures = {name: state for state in inputs.pressures for name in state.codec.index}
        self._pressure_pairs = tuple(pair and (pressures[pair[0]], *pair) for pair in LOADS)
        self._lift_a, self._lift_b = Signal(inputs.pressures[0], "LiftA"), Signal(inputs.pressures[0], "LiftB")
        self.pressure_monitor = PressureMonitor(self._pressure_pairs)
        self._loads_bar = [math.nan] * N_JOINTS
        self._load, self._load_due, self._load_updated = LoadEstimator(profile), PeriodicTimer(LOAD_PERIOD_NS), False
        self._load_change = LoadChange(LOAD_PERIOD_NS * 1e-9)
        self.load_kg = math.nan
        """Load in the grapple; NaN while unknown."""
        self.roll_rad = self.pitch_rad = 0.0
        """Inclination of the crane's base; 0 where it is not measured."""
        self.load_moment = None if profile.stability is None else LoadMoment(profile, profile.stability)
        """Whether the machine bears its load; None on a machine whose profile does not say."""
        self.commands = self.law.commands
        """Joint velocities commanded in this tick."""
        self.spools_pct = [0.0] * N_JOINTS
        self._stowed, self._borne = [math.nan] * N_JOINTS, [math.nan] * N_JOINTS
        """References at which the carrier drove off, and at which the load became too much."""
        self._noted_ns = 0
        self._measured, self._ahead = [0.0] * N_JOINTS, [0.0] * N_JOINTS
        self.leased = False
        self.lease_end_ns = 0
        self._final = False
        self._grapple_request = GrappleCommand.NEUTRAL

    # -- estimate

    def estimate_load(self, roll_rad: float, pitch_rad: float, now_ns: int) -> None:
        """Estimate the load when it is due: by the load cell where there is one, else by the lift's pressures.

        The inclination of the crane's base (0 where it is not measured) belongs to the judgement of the moment.
        """
        self.roll_rad, self.pitch_rad = roll_rad, pitch_rad
        moment, lift_pressures = self.load_moment, self._inputs.pressures[0]
        if moment is not None and lift_pressures.fresh:
            load_bar = self.law.load_pressure_bar(Joint.LIFT, self._lift_a.value(), self._lift_b.value())
            moment.update_pressure(load_bar, lift_pressures.stamp_ns)
        self._load_updated = self._load_due.due(now_ns)
        if not self._load_updated:
            return
        measured = self._inputs.grapple.get("Load")
        position = [e.position for e in self._estimators]
        if measured is not None:
            self.load_kg = float(measured)
        else:
            lift = self._estimators[Joint.LIFT]
            self.load_kg = self._load.step(
                position, lift.velocity, self._lift_a.value(), self._lift_b.value(), LOAD_PERIOD_NS * 1e-9
            )
        self._load_change.step(self.load_kg, now_ns)
        if moment is not None:
            moment.update(position, self.load_kg, roll_rad, pitch_rad)

    def pressed(self, now_ns: int) -> bool:
        """Tell whether jaws that work, or a load that comes or goes, move every joint now or did a moment ago."""
        return self.grapple.presses(now_ns) or self._load_change.recent(now_ns)

    def slew_is_pushed(self) -> bool:
        """Tell whether something from outside turns the column: no weight loads it, and its oil resists the motion.

        A valve that drives it has the pressure on the side of the motion (docs/reference/safety.md section 5).
        """
        load_bar = self._loads_bar[_SLEW]
        return self.leased and load_bar * self._estimators[_SLEW].velocity < 0.0 and abs(load_bar) > PUSHED_BAR

    # -- reference

    def update_reference(self, active: bool, cap: float, now_ns: int) -> None:
        """Compute the reference of this tick.

        It follows the trajectory in force; without one, and in a spool test, it is where the joints are.
        """
        governor = self.governor
        if active and self.leased and not self.spool_run.running:
            governor.follow(now_ns, cap)
            return
        for j, estimator in enumerate(self._estimators):
            measured = estimator.known or self._sensed[j]
            governor.hold(j, estimator.position if measured else governor.position[j], now_ns)

    # -- accept

    def keeps_in_place(self, setpoint: CraneSetpoint) -> bool:
        """Tell whether a setpoint only keeps the crane where it is, and where it was when the carrier drove off."""
        reference, stowed = self.governor.position, self._stowed
        for knot in setpoint.knots:
            for j in JOINTS:
                place = knot.position[j]
                if (
                    knot.velocity[j] != 0.0
                    or abs(place - reference[j]) > IN_PLACE_UNITS
                    or abs(place - stowed[j]) > IN_PLACE_UNITS
                ):
                    return False
        return True

    def note_places(self, drives: bool, armed: bool, now_ns: int) -> None:
        """Note the reference from which a setpoint must not lead away, once the carrier drives or the load is too much.

        A crane without a lease follows its joints, which yield: its place is noted anew, but rarely, so that setpoints
        that each lead a little away lead nowhere.
        """
        moment, renewed = self.load_moment, False
        if not self.leased and now_ns - self._noted_ns > PLACE_PERIOD_NS:
            self._noted_ns, renewed = now_ns, True
        if renewed or not drives:
            self._stowed[:] = self.governor.position
        if moment is not None and (renewed or not moment.overloaded):
            self._borne[:] = self.governor.position
        if not armed:
            self._workspace.forget()

    def is_moving(self, now_ns: int) -> bool:
        """Tell whether the reference or a spool test moves the crane."""
        return self.leased and (self.spool_run.running or not self.governor.at_rest(now_ns))

    def accept(self, setpoint: CraneSetpoint, now_ns: int) -> bool:
        """Follow a trajectory from now on; True when this ended a spool test.

        Raises:
            RequestRefused: the trajectory leaves the limits, the machine does not bear it, or a spool test holds a
                valve open.
        """
        if self.spool_run.opened(now_ns):
            raise RequestRefused(Reason.TEST_BUSY, self.spool_run.function)
        self.governor.accept(now_ns, self._continues_plan(setpoint, now_ns))
        self.lease_end_ns = setpoint.stamp_ns + setpoint.lease_ns
        self._final = setpoint.final
        self._grapple_request = setpoint.grapple
        ended_test = self.spool_run.running
        self.spool_run.end()
        return ended_test

    def _continues_plan(self, setpoint: CraneSetpoint, now_ns: int) -> bool:
        """Check a setpoint: True when it continues the plan, False when it begins at the present reference.

        Plan and reference differ only while the trajectory's time is behind the planner's.
        """
        check, governor = self._check, self.governor
        if governor.behind_ns:
            try:
                check.load_and_check(setpoint, governor.candidate, *governor.planned(now_ns), now_ns)
            except RequestRefused as refused:
                if refused.reason is not Reason.REFERENCE_JUMP:
                    raise
            else:
                check.check_behind(governor.position, governor.behind_ns * 1e-9)
                self._admit(setpoint)
                return True
        check.load_and_check(setpoint, governor.candidate, governor.position, governor.velocity, now_ns)
        self._admit(setpoint)
        return False

    def _admit(self, setpoint: CraneSetpoint) -> None:
        """Check where a trajectory within the joints' limits leads, and remember it as accepted; raises
        RequestRefused.
        """
        self._workspace.check(self.governor.position, setpoint.knots)
        moment = self.load_moment
        if moment is not None and moment.overloaded:
            for knot in (setpoint.knots[0], setpoint.knots[-1]):
                if moment.raised(self.governor.position, knot.position) or self._leads_out(knot.position):
                    raise RequestRefused(Reason.RAISES_MOMENT)
        self._gate.mark_accepted(setpoint)

    def accept_spool_test(self, test: SpoolTest, now_ns: int) -> None:
        """Run a spool test from now on; raises RequestRefused."""
        if self.leased and not self.spool_run.running and not self.governor.at_rest(now_ns):
            raise RequestRefused(Reason.TEST_BUSY, test.function)
        self.spool_run.start(test, now_ns)
        self._gate.mark_accepted(test)
        self.lease_end_ns = test.stamp_ns + test.lease_ns
        self._grapple_request = GrappleCommand.NEUTRAL

    def reset_laws(self) -> None:
        """Begin the laws again from neutral valves."""
        self.law.reset()
        if self.sway is not None:
            self.sway.reset()

    # -- supervise

    def lease_over(self, now_ns: int) -> bool:
        """Tell whether the setpoint is no longer valid: its lease is over, or its last knot still moves."""
        if now_ns >= self.lease_end_ns:
            return True
        if self.spool_run.running:
            return self.spool_run.cut_short(now_ns)
        return self.governor.ended_moving(now_ns)

    def finished(self, now_ns: int) -> bool:
        """Tell whether the requested motion is done, so that its lease may end without a fault."""
        if self.spool_run.running:
            return self.spool_run.ends_neutral(now_ns)
        return self._final and self.governor.at_rest(now_ns)

    def overloads(self) -> bool:
        """Tell whether the machine is overloaded and the crane moves outward or up all the same."""
        moment = self.load_moment
        if moment is None or not moment.overloaded or not self.leased:
            return False
        governor = self.governor
        return (
            self.spool_run.running
            or moment.raised_by_motion(governor.position, governor.velocity)
            or self._leads_out(governor.position)
        )

    def _leads_out(self, position: Sequence[float]) -> bool:
        """Tell whether a place is farther out than the crane may go on from where the load became too much."""
        return self.load_moment is not None and self.load_moment.raised(self._borne, position, BORNE_TOLERANCE_M)

    def test_leads_out(self) -> bool:
        """Tell whether the spool test in force is about to move the tip into the ground or into a box."""
        run = self.spool_run
        if not run.running:
            return False
        measured, ahead = self._measured, self._ahead
        for j, estimator in enumerate(self._estimators):
            measured[j] = ahead[j] = estimator.position
        ahead[run.function] += STOP_S * self._estimators[run.function].velocity
        return self._workspace.enters(measured, ahead)

    # -- control

    def control(self, active: bool, ramp_share: float, ramping: bool, cap: float, now_ns: int, elapsed_ns: int) -> None:
        """Run the laws while ``active``; scale the last command by ``ramp_share`` during a stop's ramp; otherwise
        command neutral.
        """
        self.leased &= active
        if self.spool_run.running:
            self._drive_spool_test(ramp_share if not active else 1.0, now_ns)
            if not active and not ramping:
                self.spool_run.end()
        else:
            self._run_laws(ramp_share, cap, now_ns, elapsed_ns)
        if self._load_updated:
            self.grapple.observe_load(self.load_kg, now_ns)

    def _run_laws(self, ramp_share: float, cap: float, now_ns: int, elapsed_ns: int) -> None:
        law, governor, inputs = self.law, self.governor, self._inputs
        if self.leased:
            pressures = self._loads_bar
            for j, source in enumerate(self._pressure_pairs):
                if source is not None:
                    state, push, against = source
                    pressures[j] = law.load_pressure_bar(j, state.get(push), state.get(against))
            elapsed_s = elapsed_ns * 1e-9
            if self.sway is not None:
                self._damp_sway(self.sway, now_ns, elapsed_s)
            law.step(
                governor.position,
                governor.velocity,
                governor.lead_velocity,
                self._estimators,
                pressures,
                cap,
                elapsed_s,
                self.sway,
            )
            clamp, release = inputs.grapple.get("ClampPress"), inputs.pressures[2].get("GrappleB")
            self.grapple.step(self._grapple_request, or_nan(clamp), self.opening_pct(), or_nan(release), now_ns)
        else:
            law.fade(ramp_share)
            self.grapple.release()
        for j, valve in enumerate(law.valves):
            self.spools_pct[j] = valve.spool_pct(self.commands[j])

    def _damp_sway(self, sway: SwayDamping, now_ns: int, elapsed_s: float) -> None:
        """Update the sway damping; it acts once the crane's reference stands."""
        state, governor = self._inputs.imu, self.governor
        swing, age_s = None, 0.0
        if state is not None and state.get("Status") in STATUS_USABLE:
            lean = tuple(state.get(name) for name in SWING)
            if None not in lean:
                swing, age_s = lean, (now_ns - state.stamp_ns) * 1e-9
        reference = (*governor.velocity[: Joint.ROT], *governor.lead_velocity[: Joint.ROT])
        stands = all(abs(v) < STANDING_UNIT_S for v in reference)
        sway.step(swing, age_s, stands, [e.position for e in self._estimators], elapsed_s)

    def _drive_spool_test(self, share: float, now_ns: int) -> None:
        """Drive one function by its spool command, all others neutral; during a stop's ramp with ``share`` of it."""
        run = self.spool_run
        for j in JOINTS:
            self.commands[j] = self.spools_pct[j] = 0.0
        self.spools_pct[run.function], self.commands[run.function] = run.drive(share, now_ns)
        self.grapple.release()

    def opening_pct(self) -> float:
        """Return the measured opening of the grapple; NaN on a machine without the sensor, whatever the bus carries."""
        return or_nan(self._inputs.grapple.get("Opening")) if self._opening_sensed else math.nan
