"""What the controller is started with: profile, rate, key; every error stops the start with one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from machine.load import ProfileError, load_profile, profile_hash
from machine.profile import Profile


class ConfigError(Exception):
    """The controller cannot start; the message says what is wrong, where, and what to do."""


@dataclass(frozen=True, slots=True)
class Settings:
    """A validated configuration.  ``key`` authenticates datagrams (None: checksum only)."""

    profile: Profile
    profile_hash: int
    rate_hz: int
    key: bytes | None = None

    @property
    def period_ns(self) -> int:
        """The tick period T."""
        return 1_000_000_000 // self.rate_hz

    @property
    def sync_lead_ns(self) -> int:
        """SYNC goes out this long before the tick that uses its answers: 0.6 T.  At 1 Mbit/s the encoders of a whole
        machine have answered after 1.4 ms at worst (can_bus.md section 8); the rest is for an adapter that is slow.
        """
        return self.period_ns * 3 // 5


def load(name_or_path: str | Path, rate_hz: int = 0, key: bytes | None = None) -> Settings:
    """Reads a profile by shipped name or path; ``rate_hz`` 0 takes the profile's rate; raises ConfigError."""
    try:
        profile = load_profile(name_or_path)
    except ProfileError as error:
        raise ConfigError(str(error)) from error
    rate_hz = rate_hz or profile.rate_hz
    if not 50 <= rate_hz <= 1000:
        raise ConfigError(f"A control rate of {rate_hz} Hz is not possible; choose 50 to 1000 Hz.")
    return Settings(profile, profile_hash(profile), rate_hz, key)
