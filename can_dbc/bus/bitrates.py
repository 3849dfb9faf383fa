"""The bit rates of the machine's two buses."""

from __future__ import annotations

from typing import Final

CRANE_BITRATE: Final = 1_000_000
MACHINE_BITRATE: Final = 250_000
BITRATES: Final = {"crane0": CRANE_BITRATE, "mach0": MACHINE_BITRATE}
"""Logical bus -> bit/s."""
