"""The newest inputs of an activity, with their times: the controller's report and the detector's log list."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Final

from autonomy.perception.log_list import LogObservation
from can_dbc.messages.crane import StateReport
from machine.joints import JOINTS
from machine.profile import Profile, joint
from machine.status.modes import Mode
from runtime.errors import Problem

REPORT_TIMEOUT_NS: Final = 300_000_000
LOG_LIST_FRESH_NS: Final = 600_000_000
"""A log list no older than this shows what hangs in the grapple now."""


class Inbox:
    """``logs`` is the newest log list and ``logs_ns`` its time, -1 before the first list."""

    __slots__ = ("_profile", "_report", "_report_ns", "logs", "logs_ns")

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._report: StateReport | None = None
        self._report_ns = 0
        self.logs: tuple[LogObservation, ...] = ()
        self.logs_ns = -1

    def accept(self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None) -> None:
        """Store what arrived since the last call, None when nothing did; a list may be empty: no log is in view."""
        if report is not None:
            self._report, self._report_ns = report, now_ns
        if logs is not None:
            self.logs, self.logs_ns = logs, now_ns

    @property
    def has_camera_measurements(self) -> bool:
        """Whether a camera measured one of the logs, or sees none: its next detection may be better."""
        return not self.logs or any(log.covariance is not None for log in self.logs)

    @property
    def report(self) -> StateReport:
        """The newest report; call only once there is one."""
        assert self._report is not None
        return self._report

    def position(self, setpoint: Sequence[float]) -> tuple[float, ...]:
        """Return the measured joints; one without an encoder counts as being at its ``setpoint``."""
        return tuple(
            p if joint(self._profile, j).encoder is not None else q
            for j, p, q in zip(JOINTS, self.report.position, setpoint, strict=True)
        )

    def blocked_reason(self, now_ns: int, setpoint: Sequence[float]) -> Problem | None:
        """Tell why the controller would execute no setpoint now."""
        if self._report is None:
            return Problem("activity.no-report", "the controller has not reported")
        if now_ns - self._report_ns > REPORT_TIMEOUT_NS:
            return Problem("activity.controller-silent", "the controller is silent")
        if self._report.mode not in (Mode.ARMED, Mode.ACTIVE):
            name = next((mode.name for mode in Mode if mode == self._report.mode), str(self._report.mode))
            return Problem("activity.controller-mode", f"the controller is in {name}")
        if not all(map(isfinite, self.position(setpoint))):
            return Problem("activity.position-unknown", "a joint position is unknown")
        return None

    def is_fresh(self, now_ns: int) -> bool:
        """Tell whether the log list shows the present moment."""
        return now_ns - self.logs_ns < LOG_LIST_FRESH_NS
