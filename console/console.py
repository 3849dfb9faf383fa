"""The console: its configuration, its state, and the commands that it sends.

One ``OperatorCommand`` datagram per command goes to the controller's operator socket, one ``MissionCommand`` or
``MissionUpload`` datagram to the planner.  `console.server` shows it as web pages.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from can_dbc.messages import operator_link
from can_dbc.messages.crane import WATCH_PERIOD_NS, OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import (
    MissionAction,
    MissionCommand,
    MissionUpload,
    encode_mission_command,
    encode_mission_upload,
)
from console.access import Access, Page
from console.access_guards import AuditLog
from console.accounts import Accounts, Person, Role
from console.can_tap import CanTap
from console.foxglove_server import FoxgloveServer
from console.state import CraneState
from machine.profile import Profile

# -- The pages that watch the machine: which heartbeats go on to the controller, and when the watch ends.  Pure.
#
# An open page that may command answers the state that it receives several times a second; each answer is a
# heartbeat of its browser, stamped with the time at which that state left.  So a cut network ends the heartbeats
# although this server runs on, and answers that waited in a slow one are as old as they are.  A page that is closed
# on purpose says so; it ends the watch unless another page is open, or has fallen silent so lately that its loss is
# still to be seen.


MIN_BEAT_NS: Final = WATCH_PERIOD_NS * 3 // 4
"""However many pages are open, the controller gets no more heartbeats than about one page's."""
CLOSED_PAGES: Final = 16
FRESH_NS: Final = 1_000_000_000
_PAGE: Final = re.compile(r"[0-9a-z-]{1,32}")
_ANSWER: Final = re.compile(r"([0-9a-z-]{1,32}) ([0-9]{1,15})")
"""The name that a page gave itself, and the ``sent_ms`` of the state that it answers."""


class PageWatch:
    """``limit_ns``: so long a silent page counts as open; 0: the profile watches no link."""

    def __init__(self, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._heard_ns: dict[str, int] = {}
        self._closed: deque[str] = deque(maxlen=CLOSED_PAGES)
        self._beat_ns = -MIN_BEAT_NS

    def beat(self, answer: str, now_ns: int) -> int | None:
        """Take the answer of a page; return the stamp of the heartbeat to send to the controller now, None for none.

        Nothing counts that is older than the limit, or was on its way while its page closed.
        """
        match = _ANSWER.fullmatch(answer)
        if match is None:
            return None
        page, left_ns = match[1], int(match[2]) * 1_000_000
        if page in self._closed or not 0 <= now_ns - left_ns < self._limit_ns:
            return None
        self._forget(now_ns)
        self._heard_ns[page] = now_ns
        if left_ns - self._beat_ns < MIN_BEAT_NS:
            return None
        self._beat_ns = left_ns
        return left_ns

    def is_fresh(self, answer: str, now_ns: int) -> bool:
        """Tell whether this is a page's answer to a state that left less than `FRESH_NS` ago."""
        match = _ANSWER.fullmatch(answer)
        return match is not None and 0 <= now_ns - int(match[2]) * 1_000_000 < FRESH_NS

    def end(self, page: str, now_ns: int) -> bool:
        """End a page that closes on purpose; tell whether the watch ends with it."""
        if not self._limit_ns or not _PAGE.fullmatch(page):
            return False
        self._forget(now_ns)
        self._heard_ns.pop(page, None)
        self._closed.append(page)
        return not self._heard_ns

    def _forget(self, now_ns: int) -> None:
        """Forget pages that were silent for the limit: the controller has held by now, or another page watches."""
        for page in [p for p, heard_ns in self._heard_ns.items() if now_ns - heard_ns >= self._limit_ns]:
            del self._heard_ns[page]


# -- The console


Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class CommissionOptions:
    """What commissioning needs: the controller's setpoint port, the profile's file, and a folder for what is kept."""

    controller: Address
    source: Path
    folder: Path


@dataclass(slots=True)
class Console:
    """Configuration and state of the console.

    ``operator`` None: the page is read-only; ``planner`` None: it sends no mission commands.
    """

    profile: Profile
    profile_hash: int
    operator: Path | None = None
    scene: Address | None = None
    key: bytes | None = None
    reports: socket.socket | None = None
    """A bound UDP socket on which the reports of controller and planner arrive."""
    planner: Address | None = None
    timing_page: Path | None = None
    missions: Path | None = None
    """Folder of the missions that are planned on the page."""
    buses: Mapping[str, str] = field(default_factory=dict)
    """Addresses of the buses whose frames the page may show, by name."""
    faults: Path | None = None
    """Socket of a live run's desk of faults; a machine has none."""
    truth: Address | None = None
    """Request port of the plant of an emulated run, for the logs as they truly are; a machine has none."""
    foxglove: FoxgloveServer | None = None
    """Serves the run to Foxglove and Lichtblick."""
    commission: CommissionOptions | None = None
    """None: this console has no page of commissioning."""
    recording: Path | None = None
    """Directory of the run's recording, which the page names when the run has ended."""
    accounts: Accounts | None = None
    """Who may sign in; None: this machine only, for whoever has the token of `Access`."""
    audit: AuditLog | None = None
    tls: bool = False
    """Whether the page is served over TLS."""
    profile_check: int = 0
    """Of the profile's file, which an ARM is meant for (`OperatorCommand`); a guard hears no other."""
    clock: Callable[[], int] = time.monotonic_ns
    access: Access = field(init=False)
    crane_state: CraneState = field(init=False)
    page_watch: PageWatch = field(init=False)
    can_tap: CanTap = field(init=False)
    _sequence: int = 0

    def __post_init__(self) -> None:
        self.access = Access(self.accounts, lambda: self.clock())
        self.crane_state = CraneState(self.profile, self.key, self.profile_hash)
        if self.foxglove is not None:
            self.crane_state.listener = self.foxglove.on_report
            self.crane_state.mission_listener = self.foxglove.on_mission
        self.page_watch = PageWatch(self.profile.timeouts.operator_link_ms * 1_000_000)
        self.can_tap = CanTap(self.profile, self.buses, lambda: self.clock())

    def command(self, action: OperatorAction, stamp_ns: int | None = None) -> None:
        """Send one operator command, stamped now unless ``stamp_ns`` is given.

        Raises:
            OSError: it cannot be sent.
        """
        assert self.operator is not None
        message = OperatorCommand(
            self._next(),
            self.profile_hash,
            self.clock() if stamp_ns is None else stamp_ns,
            action,
            self.profile_check,
        )
        operator_link.send(encode(message), self.operator)

    def watch(self, answer: str, page: Page | None) -> None:
        """Take the answer of a page: it keeps its lease.  A page that may not command watches nothing."""
        if page is None or page.person.role < Role.OPERATOR:
            return
        if self.page_watch.is_fresh(answer, self.clock()):
            self.access.lease.renew(page.number, self.clock())
        if self.operator is None:
            return
        stamp_ns = self.page_watch.beat(answer, self.clock())
        if stamp_ns is not None:
            with contextlib.suppress(OSError):  # without a controller the page shows no report
                self.command(OperatorAction.WATCH, stamp_ns)

    def mission_command(self, action: MissionAction) -> None:
        """Send one mission command to the planner.

        Raises:
            OSError: it cannot be sent.
        """
        assert self.planner is not None
        message = MissionCommand(self._next(), self.profile_hash, self.clock(), action)
        _send(encode_mission_command(message, self.key), self.planner)

    def offer(self, name: str, digest: bytes) -> int:
        """Offer a mission of the folder to the planner; the offer's sequence number.

        Raises:
            OSError: it cannot be sent.
        """
        assert self.planner is not None
        message = MissionUpload(self._next(), self.profile_hash, self.clock(), name, digest)
        _send(encode_mission_upload(message, self.key), self.planner)
        return message.sequence

    def _next(self) -> int:
        # Starts from the clock, so that commands of a restarted console are not taken for a replay.
        self._sequence = max(self._sequence + 1, self.clock() // 1_000_000 & 0x7FFF_FFFF)
        return self._sequence

    def state_for(self, page: Page | None, person: Person) -> dict[str, Any]:
        """Return the page's state, and what this page may do."""
        can, now_ns = self.operator is not None, self.clock()
        operates = page is not None and person.role >= Role.OPERATOR
        return {
            **self.crane_state.state(now_ns),
            **self.access.state(page, person),
            "sent_ms": now_ns // 1_000_000,
            "may_stop": can,
            "may_command": can and operates,
            "may_order": self.planner is not None and operates,
            "audit": "" if self.audit is None else self.audit.failed,
        }


def _send(data: bytes, to: Address) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(to)
        out.send(data)
        # On loopback the kernel reports at once that nobody listens.
        if code := out.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(code, os.strerror(code))
