"""The bit rates of the machine's two buses, as the wire runs them (`can_dbc.bus.bitrates`)."""

from __future__ import annotations

from can_dbc.bus.bitrates import BITRATES, CRANE_BITRATE, MACHINE_BITRATE

__all__ = ["BITRATES", "CRANE_BITRATE", "MACHINE_BITRATE"]
