"""Settings of the controller: profile and rate.  Every error stops the start with one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from machine.loading.profile_file import ProfileError, load_profile, profile_check, profile_hash
from machine.profile import Profile
from runtime.errors import ConfigError

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


@dataclass(frozen=True, slots=True)
class Settings:
    """A validated configuration."""

    profile: Profile
    profile_hash: int
    rate_hz: int
    file_check: int = 0
    """CRC of the profile's file, as the guard has it (`GuardStat.ProfileCheck`); 0: made without a file."""

    @property
    def period_ns(self) -> int:
        """The tick period T."""
        return 1_000_000_000 // self.rate_hz

    @property
    def sync_lead_ns(self) -> int:
        """SYNC goes out this long before the tick that uses its answers: 0.6 T.

        At 1 Mbit/s the encoders of a whole machine answer within 1.4 ms at worst (docs/reference/can-bus.md section 8);
        the rest is for a slow adapter.
        """
        return self.period_ns * 3 // 5

    @property
    def tx_queue_frames(self) -> tuple[int, int]:
        """How many own frames may wait for crane0 and for mach0: those of `TX_QUEUE_NS`.

        A full queue tells that they are old, and `controller.process.loop` cancels them.  The bound is a time,
        because at 1 kHz a number that is safe at 200 Hz is full after a few ticks.
        """
        plc = self.profile.plc
        referring = plc is not None and plc.role == "references"
        frames_per_tick = CRANE_FRAMES_PER_TICK + (REFERENCE_FRAMES_PER_TICK if referring else 0)
        ticks = -(-TX_QUEUE_NS // self.period_ns)
        return max(MIN_QUEUE_FRAMES, ticks * frames_per_tick + OCCASIONAL_FRAMES), MIN_QUEUE_FRAMES


def load(name_or_path: str | Path, rate_hz: int = 0) -> Settings:
    """Load a profile by shipped name or path; ``rate_hz`` 0 means the profile's rate.

    Raises:
        ConfigError: the profile is invalid or the rate is out of range.
    """
    try:
        profile = load_profile(name_or_path)
    except ProfileError as error:
        raise ConfigError(error.code, str(error)) from error
    rate_hz = rate_hz or profile.rate_hz
    if not 50 <= rate_hz <= 1000:
        raise ConfigError("config.rate", f"A control rate of {rate_hz} Hz is not possible; choose 50 to 1000 Hz.")
    return Settings(profile, profile_hash(profile), rate_hz, profile_check(name_or_path))
