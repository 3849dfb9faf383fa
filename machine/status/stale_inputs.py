"""The mask of stale inputs (``StateReport.stale_mask``, ``CtrlStatus``): which bit stands for which input.

A bit is set while the newest value of its input is older than the message's timeout.  The inputs of the vehicle report
have a mask of their own: `can_dbc.messages.vehicle.VEHICLE_INPUTS`.
"""

from __future__ import annotations

from typing import Final

from machine.joints import ARTICULATION, JOINTS

CRANE_INPUT_BITS: Final = {
    "EstopStat": 0,
    "GuardStat": 1,
    "ValveFbA": 8,
    "ValveFbB": 9,
    "PlcStatus": 10,
    "PressA": 11,
    "PressB": 12,
    "PressC": 13,
    "GrappleStat": 14,
}
"""Messages of crane0 other than the encoders."""

ENCODER_BIT: Final = 2
"""The encoder of a joint has bit ``ENCODER_BIT + joint``, that of the articulation ``ENCODER_BIT + ARTICULATION``."""

CARRIER_BIT: Final = 15
"""Any of the carrier's own messages on mach0 (``VehStat``, ``ArmHeightA``, ``ArmHeightB``)."""

STALE_INPUT_NAMES: Final = {
    CRANE_INPUT_BITS["EstopStat"]: "emergency stop",
    CRANE_INPUT_BITS["GuardStat"]: "guard",
    CRANE_INPUT_BITS["ValveFbA"]: "valves A",
    CRANE_INPUT_BITS["ValveFbB"]: "valves B",
    CRANE_INPUT_BITS["PlcStatus"]: "PLC",
    CRANE_INPUT_BITS["PressA"]: "pressures A",
    CRANE_INPUT_BITS["PressB"]: "pressures B",
    CRANE_INPUT_BITS["PressC"]: "pressures C",
    CRANE_INPUT_BITS["GrappleStat"]: "grapple",
    CARRIER_BIT: "carrier",
    ENCODER_BIT + ARTICULATION: "articulation encoder",
} | {ENCODER_BIT + j: f"{j.name.lower()} encoder" for j in JOINTS}
"""By bit, for the operator."""
