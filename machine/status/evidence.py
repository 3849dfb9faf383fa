"""The evidence of a reason: which signal was judged, what was measured, and the limit, as numbers with their units.

The controller keeps up to three numbers with the reason that slowed or stopped the machine: the measured value, the
limit and one more (`controller.state_report`).  ``StateReport.numbers`` carries them, NaN where there is none.  What
they mean, and their text, is in this table alone; no text is made in a tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from machine.joints import Joint
from machine.status.reasons import Reason, known

_MS: Final = "ms"
_RAD, _RAD_S, _M, _M_S, _NM, _KG, _PCT, _BAR = "rad", "rad/s", "m", "m/s", "Nm", "kg", "%", "bar"
_UNIT, _UNIT_S = "joint", "joint/s"
"""rad or m, by the joint that the detail names."""
_COUNT, _BITS, _REASON = "", "bits", "reason"
_SHOWN: Final = {
    _RAD: (180.0 / math.pi, 2, "°"),
    _RAD_S: (180.0 / math.pi, 2, "°/s"),
    _M: (1.0, 3, " m"),
    _M_S: (1.0, 3, " m/s"),
    _MS: (1.0, 1, " ms"),
    _NM: (1e-3, 1, " kNm"),
    _KG: (1.0, 0, " kg"),
    _BAR: (1.0, 1, " bar"),
}
"""By unit: factor, decimals and mark for a person."""


class Measurement(NamedTuple):
    """What the numbers of one reason are.

    ``signal`` names the first one, ``limit`` the second and ``other`` the third; an empty name means that there is
    none.  ``unit`` is that of the first two, ``other_unit`` that of the third.
    """

    signal: str
    unit: str = _COUNT
    limit: str = "limit"
    other: str = ""
    other_unit: str = _COUNT


class Quantity(NamedTuple):
    """One number of the evidence: its name, its value in SI units (times in ms) and the unit."""

    name: str
    value: float
    unit: str

    @property
    def text(self) -> str:
        """Name, value and unit for a person; angles in degrees."""
        return f"{self.name} {_shown(self.value, self.unit)}"


def _age(of: str) -> Measurement:
    return Measurement(f"age of {of}", _MS, "limit", "frames refused since the start")


_HEARTBEAT: Final = Measurement("age of its heartbeat", _MS)
_EMERGENCY: Final = Measurement("emergency error code (CiA 301)", _BITS, "")
_MOTION: Final = Measurement("velocity", _UNIT_S, "speed limit", "commanded", _UNIT_S)
_SPOOL: Final = Measurement("spool", _PCT, "", "commanded", _PCT)
_BUS: Final = Measurement("error frames since the start", _COUNT, "", "recoveries")
_STEERING: Final = Measurement("rate of the articulation", _RAD_S, "", "commanded", _RAD_S)

EVIDENCE: Final[dict[Reason, Measurement]] = {
    Reason.OPERATOR_LINK_LOST: Measurement("age of the operator's last heartbeat", _MS),
    Reason.ESTOP_PRESSED: Measurement("channel A", _COUNT, "released is", "channel B"),
    Reason.ESTOP_CHANNELS: Measurement("channel A", _COUNT, "released is", "channel B"),
    Reason.ESTOP_LOST: _age("the last good EstopStat"),
    Reason.GUARD_LOST: _age("the last good GuardStat"),
    Reason.GUARD_REFUSES: Measurement("the guard's verdict", _COUNT, "", "axis"),
    Reason.ENCODER_LOST: _age("its last good sample"),
    Reason.ENCODER_JUMP: Measurement("position after the jump", _UNIT, "", "samples refused since the start"),
    Reason.ENCODER_ALARM: Measurement("alarm word", _BITS, ""),
    Reason.POSITION_OUTSIDE: Measurement("position", _UNIT),
    Reason.VALVE_FEEDBACK_LOST: _age("the last good feedback"),
    Reason.VALVE_ECHO_STUCK: Measurement("time without a newly accepted command", _MS, "limit", "exit code"),
    Reason.VALVE_NODE_FAULT: Measurement("state of the valve node", _COUNT, "", "exit code"),
    Reason.PLC_LOST: _age("the last good PlcStatus or PlcOut"),
    Reason.PLC_FAULT: Measurement("fault bits", _BITS, ""),
    Reason.PRESSURE_LOST: _age("its last good frame"),
    Reason.GRAPPLE_STATUS_LOST: _age("the last good GrappleStat"),
    Reason.SAFETY_NODE_LOST: _HEARTBEAT,
    Reason.ENCODER_NODE_LOST: _HEARTBEAT,
    Reason.PRESSURE_NODE_LOST: _HEARTBEAT,
    Reason.NODE_RESTARTED: Measurement("NMT state", _COUNT, "operational is", "boot-ups since the start"),
    Reason.EMERGENCY_MESSAGE: _EMERGENCY,
    Reason.EMERGENCY_WARNING: _EMERGENCY,
    Reason.CARRIER_LOST: _age("the last good VehStat"),
    Reason.SWING_ARMS_LOST: _age("the last good arm heights"),
    Reason.BUS_OFF: _BUS,
    Reason.BUS_DOWN: _BUS,
    Reason.BUS_PASSIVE: _BUS,
    Reason.INPUTS_LOST: Measurement("age of the newest frame on the bus", _MS, "", "inputs lost"),
    Reason.SEND_REFUSED: Measurement("frames that the bus refused since the start", _COUNT, ""),
    Reason.LOOP_LATE: Measurement("lateness", _MS, "limit", "late ticks since the start"),
    Reason.LOOP_STALLED: Measurement("lateness", _MS, "limit", "late ticks since the start"),
    Reason.PROFILE_DIFFERS: Measurement("the check of the guard's profile", _COUNT, "that of the controller's"),
    Reason.COMPUTER_STALLED: Measurement("stood still for", _MS, "", "inputs lost"),
    Reason.LEASE_LOST: Measurement("age of the last setpoint", _MS, "lease"),
    Reason.SETPOINTS_REFUSED: Measurement("setpoints refused since the start", _COUNT, "", "the last one for", _REASON),
    Reason.SPOOL_OPEN: _SPOOL,
    Reason.SPOOL_SHUT: _SPOOL,
    Reason.SPOOL_WRONG: _SPOOL,
    Reason.SPEED_WRONG: _MOTION,
    Reason.JOINT_STUCK: _MOTION,
    Reason.JOINT_RUNAWAY: _MOTION,
    Reason.JOINT_REVERSED: _MOTION,
    Reason.MOVES_WHILE_STOPPED: _MOTION,
    Reason.ENCODER_FROZEN: Measurement("commanded", _UNIT_S, "speed limit", "frames refused since the start"),
    Reason.ENCODER_NOISY: _MOTION,
    Reason.ENCODER_DRIFT: _MOTION,
    Reason.OVERLOAD: Measurement("moment about the tipping line", _NM, "limit", "load", _KG),
    Reason.OVERLOADED: Measurement("moment about the tipping line", _NM, "limit", "load", _KG),
    Reason.HOSE_BURST: Measurement("pressure in the chamber", _BAR, "", "before", _BAR),
    Reason.TEST_RANGE: Measurement("position", _UNIT, "end of the range"),
    Reason.TEST_SPEED: Measurement("velocity", _UNIT_S, "speed limit"),
    Reason.POSITION_LOST: _age("the last good position"),
    Reason.HEADING_LOST: _age("the last good heading"),
    Reason.FIX_LOST: Measurement("method of the solution", _COUNT, "", "RTK fixed is"),
    Reason.CARRIER_FAULT: Measurement("fault number", _COUNT, ""),
    Reason.CARRIER_RUNAWAY: Measurement("speed", _M_S, "", "commanded", _M_S),
    Reason.CARRIER_STUCK: Measurement("speed", _M_S, "", "commanded", _M_S),
    Reason.STEERING_DISAGREES: Measurement("the encoder's angle", _RAD, "allowed difference", "the vehicle's", _RAD),
    Reason.TILTED: Measurement("tilt", _RAD),
    Reason.ARM_OUTSIDE: Measurement("height", _M, "travel"),
    Reason.ARM_STUCK: Measurement("height", _M, "travel", "commanded", _M_S),
    Reason.STEERING_STUCK: _STEERING,
    Reason.STEERING_RUNAWAY: _STEERING,
}
"""Reasons that a number shows; the others have none."""


def quantities(reason: Reason, detail: int, numbers: Sequence[float | None]) -> tuple[Quantity, ...]:
    """List the numbers of a reason that are known, with names and units; none for a reason without an entry."""
    measured = EVIDENCE.get(reason)
    if measured is None:
        return ()
    names = (measured.signal, measured.limit, measured.other)
    units = (measured.unit, measured.unit, measured.other_unit)
    return tuple(
        Quantity(name, value, _unit_of_joint(unit, detail))
        for name, unit, value in zip(names, units, numbers, strict=False)
        if name and value is not None and math.isfinite(value)
    )


def _unit_of_joint(unit: str, joint: int) -> str:
    slides = joint == Joint.EXT
    return {_UNIT: _M if slides else _RAD, _UNIT_S: _M_S if slides else _RAD_S}.get(unit, unit)


def _shown(value: float, unit: str) -> str:
    if unit == _BITS:
        return f"{int(value):04X}h"
    if unit == _REASON:
        refused = known(int(value))
        return f"reason {int(value) & 0xFF}" if refused is None else refused.name
    if unit not in _SHOWN:
        return f"{value:g}"
    factor, decimals, mark = _SHOWN[unit]
    return f"{value * factor:.{decimals}f}{mark}"
