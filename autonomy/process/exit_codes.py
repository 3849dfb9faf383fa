"""Exit codes of the planning process."""

from __future__ import annotations

from typing import Final

FINE: Final = 0
"""The log lies in the bunk, or the mission is finished."""
CONFIGURATION: Final = 3
"""Profile, mission, checkpoint or key cannot be used."""
BUSY: Final = 4
"""A port is in use."""
SAFETY: Final = 5
"""Interrupted while the controller was in STOP or FAULT."""
FAILED: Final = 6
"""The job failed."""
INTERRUPTED: Final = 130
