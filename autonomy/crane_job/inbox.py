"""What an activity last heard, and when: the controller's report and the detector's log list."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Final

from autonomy.perception.log_list.observation import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import JOINTS
from machine.status.modes import Mode
from machine.profile import Profile, joint

REPORT_TIMEOUT_NS: Final = 300_000_000
LOG_LIST_FRESH_NS: Final = 600_000_000
"""A log list that is no older says what hangs in the grapple now."""


class Inbox:
    """``logs`` with their time ``logs_ns``, -1 before the first list; what is older than the newest is forgotten."""

    __slots__ = ("_profile", "_report", "_report_ns", "logs", "logs_ns")

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._report: StateReport | None = None
        self._report_ns = 0
        self.logs: tuple[LogObservation, ...] = ()
        self.logs_ns = -1

    def accept(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...]) -> None:
        """What came since the last call; None and () when nothing did."""
        if report is not None:
            self._report, self._report_ns = report, now_ns
        if logs:
            self.logs, self.logs_ns = logs, now_ns

    @property
    def has_camera_measurements(self) -> bool:
        """Whether a camera measured one of the logs: what it sees next may be better."""
        return any(log.covariance is not None for log in self.logs)

    @property
    def report(self) -> StateReport:
        """The newest report, once there is one."""
        assert self._report is not None
        return self._report

    def position(self, sent: Sequence[float]) -> tuple[float, ...]:
        """The measured joints; one without an encoder counts as standing where it was last ``sent``."""
        return tuple(
            p if joint(self._profile, j).encoder is not None else q
            for j, p, q in zip(JOINTS, self.report.position, sent, strict=True)
        )

    def blocked_reason(self, now_ns: int, sent: Sequence[float]) -> str | None:
        """Why no setpoint would be obeyed now."""
        if self._report is None:
            return "the controller has not reported"
        if now_ns - self._report_ns > REPORT_TIMEOUT_NS:
            return "the controller is silent"
        if self._report.mode not in (Mode.ARMED, Mode.ACTIVE):
            name = next((mode.name for mode in Mode if mode == self._report.mode), str(self._report.mode))
            return f"the controller is in {name}"
        if not all(map(isfinite, self.position(sent))):
            return "a joint position is unknown"
        return None

    def is_fresh(self, now_ns: int) -> bool:
        """Whether the log list is of this moment."""
        return now_ns - self.logs_ns < LOG_LIST_FRESH_NS
