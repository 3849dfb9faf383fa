"""The PLC program's joint law: paper A's PD at 50 Hz on feedback of 0.1 degree and 0.1 mm
(docs/reference/machines.md sections 1.6 and 4)::

    v = qd_ref + Kp (q_ref - q) + Kd (qd_ref - qd),   u = DBinv(v / full speed)

Own code and own gains of the emulated PLC: it shares nothing with the controller's law.
"""

from __future__ import annotations

import math

from machine.motion_limits import SPEED_HEADROOM_SHARE
from machine.profile import JointSpec, Valve

RESOLUTION_RAD = math.radians(0.1)
RESOLUTION_M = 1e-4
KP_1_S = 3.0
KP_ROTATOR_1_S = 1.5
"""A log in the tongs swings about the rotator, which at 3 1/s feeds the swing (one job of twenty, sampled machines)."""
KD = 0.1
STOP_BAND_S = 0.01
ACCELERATION_LIMIT_FACTOR = 4.0
END_GAIN_1_S = 4.0
LINEAR_SHARE = 0.01


def resolution(spec: JointSpec) -> float:
    """One count of the PLC's feedback [rad, m]."""
    return RESOLUTION_M if spec.kind == "prismatic" else RESOLUTION_RAD


def stop_band(spec: JointSpec) -> float:
    """Band around the reference in which a joint rests: two counts, or its travel in 10 ms at its speed limit."""
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
        """The valve is at neutral."""
        self._command = 0.0
        self._resting = True

    def measure(self, position: float, elapsed_s: float) -> None:
        """A reading of the encoder, ``elapsed_s`` after the last one."""
        counted = round(position / self._resolution) * self._resolution
        if self._known:
            share = -math.expm1(-elapsed_s / self._spec.law.velocity_filter_s)
            self._filtered += share * ((counted - self.position) / elapsed_s - self._filtered)
        self.position, self._known = counted, True
        self.velocity = round(self._filtered / self._resolution) * self._resolution

    def step(self, q_ref: float, v_ref: float, speed: float, elapsed_s: float) -> float:
        """The valve's opening, -1..1; ``speed`` is the share of the speed limit that may be used."""
        spec = self._spec
        command = v_ref
        if spec.encoder is not None:
            error = q_ref - self.position
            band = stop_band(spec) if self._resting else self._rest_band
            self._resting = v_ref == 0.0 and abs(error) < band
            command = 0.0 if self._resting else v_ref + self._kp_1_s * error + KD * (v_ref - self._filtered)
            command = min(command, max(0.0, (spec.upper - self.position) * END_GAIN_1_S))
            command = max(command, min(0.0, (spec.lower - self.position) * END_GAIN_1_S))
        limit = SPEED_HEADROOM_SHARE * spec.speed_limit * speed
        change = ACCELERATION_LIMIT_FACTOR * spec.acceleration_limit * elapsed_s
        command = min(max(command, -limit), limit)
        self._command = min(max(command, self._command - change), self._command + change)
        return valve_opening(spec.valve, self._command)


def valve_opening(valve: Valve, velocity: float) -> float:
    """The inverse of the valve's dead-band, linear in the first per cent."""
    if velocity >= 0.0:
        share, deadband, sign = velocity / valve.full_speed_plus, valve.deadband_plus_pct / 100.0, valve.sign
    else:
        share, deadband, sign = -velocity / valve.full_speed_minus, valve.deadband_minus_pct / 100.0, -valve.sign
    share = min(share, 1.0)
    edge = deadband + (1.0 - deadband) * max(share, LINEAR_SHARE)
    return sign * (edge if share > LINEAR_SHARE else edge * share / LINEAR_SHARE)
