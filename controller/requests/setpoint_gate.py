"""Admission of one kind of setpoint: profile, order, age and lease, and the memory of refusals.

A request is refused whole with a `Reason` (`RequestRefused`), or accepted; nothing is corrected.  Fixed size.
"""

from __future__ import annotations

from typing import Final, Protocol

from machine.profile import Profile
from machine.status.reasons import Reason

REFUSED_WINDOW_NS: Final = 1_000_000_000
REFUSED_LIMIT_COUNT: Final = 3


class RequestRefused(Exception):
    """A datagram or request that is refused whole; ``reason`` is its code."""

    def __init__(self, reason: Reason, detail: int = 0) -> None:
        super().__init__(reason)
        self.reason = reason
        self.detail = detail


class LeasedSetpoint(Protocol):
    """The header that all setpoints share."""

    @property
    def sequence(self) -> int: ...
    @property
    def profile_hash(self) -> int: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def lease_ns(self) -> int: ...


class SetpointGate:
    """Order and leases of one kind of setpoint; ``refused`` counts refusals, ``refusal`` and ``detail`` are the
    last.
    """

    __slots__ = (
        "_counted",
        "_lease_max_ns",
        "_profile_hash",
        "_refused_ns",
        "_sequence",
        "_stamp_ns",
        "detail",
        "refusal",
        "refused",
    )

    def __init__(self, profile: Profile, profile_hash: int) -> None:
        self._lease_max_ns = profile.timeouts.lease_max_ms * 1_000_000
        self._profile_hash = profile_hash
        self._sequence = self._stamp_ns = -1
        self._refused_ns = [-REFUSED_WINDOW_NS] * REFUSED_LIMIT_COUNT
        self._counted = 0
        self.refused = 0
        self.refusal = Reason.NONE
        self.detail = 0

    @property
    def sequence(self) -> int:
        """Sequence number of the last accepted setpoint, 0 before the first."""
        return max(self._sequence, 0)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last accepted setpoint, 0 before the first."""
        return max(self._stamp_ns, 0)

    def start_session(self) -> None:
        """An operator armed: a planner may count from the beginning again.  Stamps must still grow."""
        self._sequence = -1

    def count_refusal(self, reason: Reason, detail: int, now_ns: int) -> None:
        """Count and remember a refusal."""
        self.refusal, self.detail = reason, detail
        self._refused_ns[self._counted % REFUSED_LIMIT_COUNT] = now_ns
        self._counted += 1
        self.refused += 1

    def note_stranger(self) -> None:
        """Count and remember a datagram without the right key: whoever sent it, it says nothing of the planner."""
        self.refusal, self.detail = Reason.DATAGRAM_AUTHENTICATION, 0
        self.refused += 1

    def clear_refusals(self) -> None:
        """A motion begins: refusals from before it do not count against it."""
        for i in range(REFUSED_LIMIT_COUNT):
            self._refused_ns[i] = -REFUSED_WINDOW_NS

    def refused_too_often(self, now_ns: int) -> bool:
        """Whether the last three refusals lie within one second."""
        oldest_ns = self._refused_ns[self._counted % REFUSED_LIMIT_COUNT]
        return now_ns - oldest_ns < REFUSED_WINDOW_NS

    def check(self, setpoint: LeasedSetpoint, now_ns: int, late_ns: int) -> None:
        """Check profile, order, age and lease of a setpoint.

        ``late_ns`` is how late the tick runs: the sender's clock may be that far ahead of the nominal time.

        Raises:
            RequestRefused: one of them does not fit.
        """
        if setpoint.profile_hash != self._profile_hash:
            raise RequestRefused(Reason.WRONG_PROFILE)
        if setpoint.sequence <= self._sequence or setpoint.stamp_ns <= self._stamp_ns:
            raise RequestRefused(Reason.OUT_OF_ORDER)
        if setpoint.stamp_ns > now_ns + late_ns:
            raise RequestRefused(Reason.STAMP_FUTURE)
        if setpoint.lease_ns > self._lease_max_ns:
            raise RequestRefused(Reason.LEASE_TOO_LONG)
        if setpoint.stamp_ns + setpoint.lease_ns <= now_ns:
            raise RequestRefused(Reason.STAMP_OLD)

    def mark_accepted(self, setpoint: LeasedSetpoint) -> None:
        """Remember an accepted setpoint: from now on only later ones are accepted."""
        self._sequence, self._stamp_ns = setpoint.sequence, setpoint.stamp_ns
