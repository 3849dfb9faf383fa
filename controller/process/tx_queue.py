"""How many own frames may wait for a bus: those of `TX_QUEUE_NS`, so that a full queue tells that they are old.

`controller.process.bus_link` then cancels them.  The bound is a time, because at 1 kHz a number that is safe at 200 Hz
is full after a few ticks.
"""

from __future__ import annotations

from typing import Final

from controller.config import Settings

TX_QUEUE_NS: Final = 20_000_000
"""Own frames wait at most about this long for a bus."""
CRANE_FRAMES_PER_TICK: Final = 3
"""Both valve commands and SYNC."""
REFERENCE_FRAMES_PER_TICK: Final = 3
"""The joint references for a PLC that closes the joint loops."""
OCCASIONAL_FRAMES: Final = 4
"""Status, heartbeat, and requests of the start-up."""
MIN_QUEUE_FRAMES: Final = 8
"""More than a single tick sends; on mach0 two periods of its commands."""


def crane_queue_frames(settings: Settings) -> int:
    """Limit of the transmit queue for crane0."""
    plc = settings.profile.plc
    referring = plc is not None and plc.role == "references"
    frames_per_tick = CRANE_FRAMES_PER_TICK + (REFERENCE_FRAMES_PER_TICK if referring else 0)
    ticks = -(-TX_QUEUE_NS // settings.period_ns)
    return max(MIN_QUEUE_FRAMES, ticks * frames_per_tick + OCCASIONAL_FRAMES)
