"""How far a controller may go beyond the limits of the profile's joints that a planner keeps."""

from __future__ import annotations

from typing import Final

SPEED_HEADROOM_SHARE: Final = 1.25
"""Share of a joint's speed limit that a correction may use, so that a joint behind its reference can catch up."""
