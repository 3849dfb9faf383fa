"""The PLC program: every 10 ms it reads the inputs, checks the command and sets the valves.

Pure: ``scan(now_ns)``.  HOLD is neutral; a command that is armed and at most 50 ms old makes it EXECUTE; an older one
ramps to neutral within 40 ms and holds.  A heartbeat that is missing for the watchdog's time (300 ms), or an open
emergency stop, makes it SAFE at once, and only a reset edge of a command that is not armed ends that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from can_dbc.plc import map as plc
from can_dbc.plc.map import (
    ESTOP_BYTES,
    N_JOINTS,
    Bounds,
    Estop,
    Fault,
    Feedback,
    Grapple,
    Mode,
    Role,
    State,
    WordOrder,
)
from machine.joints import JOINTS
from machine.profile import SPEED_HEADROOM_SHARE, JointSpec, Profile, Valve, joint
from sim.plc.command_arbiter import MS, CommandArbiter

# -- The PLC program's joint law: paper A's PD at 50 Hz on feedback of 0.1 degree and 0.1 mm
# (docs/reference/machines.md sections 1.6 and 4)::
#
#     v = qd_ref + Kp (q_ref - q) + Kd (qd_ref - qd),   u = DBinv(v / full speed)
#
# Own code and own gains of the emulated PLC: it shares nothing with the controller's law.


RESOLUTION_RAD = math.radians(0.1)
RESOLUTION_M = 1e-4
KP_1_S = 3.0
KP_ROTATOR_1_S = 1.5
"""A log in the tongs swings about the rotator, which at 3 1/s feeds the swing (one job of twenty, sampled machines)."""
KD = 0.1
STOP_BAND_S = 0.01
SPEED_SHARE = 0.75
"""Of the speed limit: this law learns no gain.  The valve of an individual machine gives up to 1.3 times what it is
asked for, its oil swings beyond that, and the guard stops a joint that lasts above 1.1 times its limit
(docs/how-to/guard.md).  At 0.92 the lift of one of nine individuals came to 1.29 times its limit; a log takes half a
second longer."""
ACCELERATION_LIMIT_FACTOR = 4.0
END_GAIN_1_S = 4.0
LINEAR_SHARE = 0.01


def resolution(spec: JointSpec) -> float:
    """Return one count of the PLC's feedback [rad, m]."""
    return RESOLUTION_M if spec.kind == "prismatic" else RESOLUTION_RAD


def stop_band(spec: JointSpec) -> float:
    """Find the band around the reference in which a joint rests: two counts, or 10 ms of travel at its speed limit."""
    return max(2.0 * resolution(spec), STOP_BAND_S * spec.speed_limit)


class PdLaw:
    """The law of one joint; ``position`` and ``velocity`` are the PLC's feedback, in whole counts."""

    def __init__(self, spec: JointSpec) -> None:
        self._spec, self._resolution = spec, resolution(spec)
        self._kp_1_s = KP_ROTATOR_1_S if spec.valve.signal == "Rot" else KP_1_S
        # Nearer than this the law asks for less than the valve gives: it would wait there for ever.
        asked = LINEAR_SHARE * min(spec.valve.full_speed_plus, spec.valve.full_speed_minus) / self._kp_1_s
        self._rest_band = min(stop_band(spec), max(0.5 * stop_band(spec), asked))
        self.position = self.velocity = 0.0
        self._filtered = 0.0
        self._known = False
        self.reset()

    def reset(self) -> None:
        """Set the state of a valve at neutral."""
        self._command = 0.0
        self._resting = True

    def measure(self, position: float, elapsed_s: float) -> None:
        """Take a reading of the encoder, ``elapsed_s`` after the last one."""
        counted = round(position / self._resolution) * self._resolution
        if self._known:
            share = -math.expm1(-elapsed_s / self._spec.law.velocity_filter_s)
            self._filtered += share * ((counted - self.position) / elapsed_s - self._filtered)
        self.position, self._known = counted, True
        self.velocity = round(self._filtered / self._resolution) * self._resolution

    def step(self, q_ref: float, v_ref: float, speed: float, elapsed_s: float) -> float:
        """Compute the valve's opening, -1..1; ``speed`` is the share of the speed limit that may be used."""
        spec = self._spec
        command = v_ref
        if spec.encoder is not None:
            error = q_ref - self.position
            band = stop_band(spec) if self._resting else self._rest_band
            self._resting = v_ref == 0.0 and abs(error) < band
            command = 0.0 if self._resting else v_ref + self._kp_1_s * error + KD * (v_ref - self._filtered)
            command = min(command, max(0.0, (spec.upper - self.position) * END_GAIN_1_S))
            command = max(command, min(0.0, (spec.lower - self.position) * END_GAIN_1_S))
        limit = SPEED_SHARE * spec.speed_limit * speed
        change = ACCELERATION_LIMIT_FACTOR * spec.acceleration_limit * elapsed_s
        command = min(max(command, -limit), limit)
        self._command = min(max(command, self._command - change), self._command + change)
        return valve_opening(spec.valve, self._command)


def valve_opening(valve: Valve, velocity: float) -> float:
    """Invert the valve's dead-band, linear in the first per cent."""
    if velocity >= 0.0:
        share, deadband, sign = velocity / valve.full_speed_plus, valve.deadband_plus_pct / 100.0, valve.sign
    else:
        share, deadband, sign = -velocity / valve.full_speed_minus, valve.deadband_minus_pct / 100.0, -valve.sign
    share = min(share, 1.0)
    edge = deadband + (1.0 - deadband) * max(share, LINEAR_SHARE)
    return sign * (edge if share > LINEAR_SHARE else edge * share / LINEAR_SHARE)


# -- The PLC program


CYCLE_NS = 10 * MS
LAW_CYCLE_COUNT = 2  # the joint law runs at 50 Hz
HOLD_NS = 50 * MS
RAMP_NS = 40 * MS
HOLD_SHARE = -0.2  # a held grapple gets a small closing flow, which maintains its pressure
MOTION_ALLOWED = Estop.CHANNEL_A | Estop.CHANNEL_B | Estop.PILOT_ON


@dataclass(slots=True)
class Inputs:
    """Readings of the PLC's input cards: joint positions (None without encoder), pressures, grapple, emergency stop.

    ``estop`` are the contacts that the PLC itself obeys; ``estop_frame`` is the safety module's newest EstopStat.
    """

    positions: tuple[float | None, ...]
    pressure_bar: tuple[float, ...]
    opening: float
    load_kg: float
    estop: int
    estop_frame: bytes = bytes(ESTOP_BYTES)


def bounds_of(profile: Profile, role: Role) -> Bounds:
    """Return the values that a command may hold on this machine."""
    if role is Role.VALVES:
        return Bounds.valves()
    specs = [joint(profile, j) for j in JOINTS]
    return Bounds.references([(s.lower, s.upper, SPEED_HEADROOM_SHARE * s.speed_limit) for s in specs])


class Program:
    """The PLC: ``arbiter`` accepts commands, ``outputs`` are the valves' openings -1..1 (five joints, grapple)."""

    def __init__(
        self,
        profile: Profile,
        role: Role,
        inputs: Callable[[int], Inputs],
        order: WordOrder = WordOrder.HIGH_FIRST,
        draw: Callable[[], int] | None = None,
        key: bytes | None = None,
    ) -> None:
        self.arbiter = CommandArbiter(bounds_of(profile, role), order, draw, key)
        self.state = State.INIT
        self.outputs = [0.0] * (N_JOINTS + 1)
        self.feedback = Feedback()
        self._inputs = inputs
        self._laws = [PdLaw(joint(profile, j)) for j in JOINTS]
        self._next_ns = self._measured_ns = 0
        self._cycles = self._longest_us = 0
        self._lost_ns: int | None = None
        self._from = list(self.outputs)

    def scan(self, now_ns: int) -> list[float]:
        """Return the outputs at ``now_ns``; a cycle runs when it is due."""
        if now_ns >= self._next_ns:
            self._next_ns = max(self._next_ns + CYCLE_NS, now_ns + CYCLE_NS // 2)
            self._cycle(now_ns)
        return self.outputs

    def status(self) -> list[int]:
        """Return the present status block; it includes commands accepted since the last cycle."""
        feedback = replace(self.feedback, accepted=self.arbiter.sequence & 0xFFFF)
        return plc.status_registers(feedback, self.arbiter.watchdog_ms, self.arbiter.order)

    def _cycle(self, now_ns: int) -> None:
        inputs = self._inputs(now_ns)
        self._cycles += 1
        elapsed_ns, self._measured_ns = now_ns - self._measured_ns, now_ns
        if self._cycles > 1:
            self._longest_us = max(self._longest_us, elapsed_ns // 1000)
        for law, position in zip(self._laws, inputs.positions, strict=True):
            if position is not None:
                law.measure(position, elapsed_ns * 1e-9)
        self._decide(inputs.estop, now_ns)
        if self.state is State.EXECUTE:
            if self._cycles % LAW_CYCLE_COUNT == 0 or self.arbiter.command.mode is not Mode.REFERENCES:
                self.outputs = self._execute()
        elif self._lost_ns is not None:
            left = 1.0 - (now_ns - self._lost_ns) / RAMP_NS
            self.outputs = [max(0.0, left) * u for u in self._from]
        else:
            self.outputs = [0.0] * len(self.outputs)
        self.feedback = self._make_feedback(inputs, now_ns)

    def _decide(self, estop: int, now_ns: int) -> None:
        """Decide the state of this cycle."""
        arbiter = self.arbiter
        may_move = estop & MOTION_ALLOWED == MOTION_ALLOWED
        reset = arbiter.take_reset_edge()
        if not may_move:
            self._make_safe(Fault.EMERGENCY_STOP)
        elif arbiter.commanded() and arbiter.commander(now_ns) is None:
            self._make_safe(Fault.WATCHDOG)
            arbiter.release()
        elif self.state is State.SAFE:
            if reset and not arbiter.command.armed:
                self.state = State.HOLD
        elif (
            arbiter.commanded()
            and arbiter.command.armed
            and arbiter.age_ns(now_ns) <= HOLD_NS
            and arbiter.fault is Fault.NONE
        ):
            if self.state is not State.EXECUTE:
                for law in self._laws:
                    law.reset()
            self.state, self._lost_ns = State.EXECUTE, None
        elif self.state is State.EXECUTE:
            self.state, self._lost_ns = State.HOLD, now_ns
            self._from = list(self.outputs)
            self._from[-1] = 0.0  # the grapple's valve closes at once and holds
        else:
            self.state = State.HOLD

    def _make_safe(self, fault: Fault) -> None:
        self.state, self._lost_ns = State.SAFE, None
        self.arbiter.latch_fault(fault)

    def _execute(self) -> list[float]:
        command = self.arbiter.command
        out = [0.0] * (N_JOINTS + 1)
        if command.mode is Mode.VALVES:
            out[:N_JOINTS] = command.reference[:N_JOINTS]
        elif command.mode is Mode.REFERENCES:
            speed, cycle_s = command.max_speed_pct / 100.0, LAW_CYCLE_COUNT * CYCLE_NS * 1e-9
            out[:N_JOINTS] = [
                law.step(command.reference[i], command.rate[i], speed, cycle_s) for i, law in enumerate(self._laws)
            ]
        if command.mode is not Mode.REFERENCES:
            for law in self._laws:
                law.reset()
        flow = command.grapple_pct / 100.0
        match command.grapple:
            case Grapple.OPEN:
                out[-1] = flow
            case Grapple.CLOSE:
                out[-1] = -flow
            case Grapple.HOLD:
                out[-1] = HOLD_SHARE
        return out

    def _make_feedback(self, inputs: Inputs, now_ns: int) -> Feedback:
        arbiter, spare = self.arbiter, (0.0,) * (plc.N_AXES - N_JOINTS)
        return Feedback(
            heartbeat=self._cycles & 0xFFFF,
            state=self.state,
            fault=arbiter.fault,
            fault_axis=arbiter.fault_axis,
            estop=inputs.estop,
            accepted=arbiter.sequence & 0xFFFF,
            longest_cycle_us=self._longest_us,
            position=tuple(law.position for law in self._laws) + spare,
            velocity=tuple(law.velocity for law in self._laws) + spare,
            pressure_bar=inputs.pressure_bar,
            opening=min(max(inputs.opening, 0.0), 1.0),
            load_kg=min(max(round(inputs.load_kg), 0), 4093),
            estop_frame=inputs.estop_frame,
            sampled_us=now_ns // 1000 & 0xFFFF,
            output=(*self.outputs, 0.0),
        )
