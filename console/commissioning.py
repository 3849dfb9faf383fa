"""Runs one procedure of commissioning at a time: the step of a joint, or a calibration.

A thread beside the server feeds the procedure with the controller's reports and the frames of the crane's bus, and
sends its setpoints to the controller, which checks them as any planner's.  It ends the procedure when the page that
began it has lost the control lease.  The bus is opened read-only, and only while a procedure runs.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import socket
import threading
import time
import tomllib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Protocol

from autonomy.calibration.plan import make_plan, task_name
from autonomy.calibration.procedure import Calibration
from autonomy.calibration.procedure_state import PATIENCE_S
from autonomy.calibration.profile_file import Change, profile_changes, write_profile
from autonomy.calibration.report import write_report
from autonomy.calibration.result import identify
from autonomy.commissioning.step_test import StepResult, StepTest
from can_dbc.bus.base import Bus
from can_dbc.bus.factory import open_bus
from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import StateReport
from machine.joints import JOINTS, Joint
from machine.profile import Profile
from runtime.errors import InputRefused, LinkError, TimberhandError

POLL_S: Final = 0.01
LEASE_LOST: Final = "the page that began it has no control any more"
DECIMALS: Final = 5


class Procedure(Protocol):
    """What is run: `StepTest` or `Calibration`."""

    @property
    def failure(self) -> str | None: ...
    @property
    def waiting(self) -> str | None: ...
    @property
    def done(self) -> bool: ...

    idle: bool

    def abort(self, reason: str) -> None: ...
    def step(self, now_ns: int, report: StateReport | None, frames: Sequence[Frame] = ()) -> bytes | None: ...


@dataclass(slots=True)
class Commissioning:
    """``report`` gives the newest report, ``source`` is the profile's file, ``folder`` gets what is written."""

    profile: Profile
    profile_hash: int
    source: Path
    folder: Path
    controller: tuple[str, int]
    bus: str
    key: bytes | None
    report: Callable[[], StateReport | None]
    steps: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The newest result of each joint's step, by its name."""
    found: dict[str, Any] | None = None
    """What the newest calibration has found: its folder's name, the plots there, every value before and after."""
    _doing: str = ""
    _procedure: Procedure | None = None
    _thread: threading.Thread | None = None
    _failure: str = ""
    _said: str = ""
    _beginning: threading.Lock = field(default_factory=threading.Lock)

    @property
    def busy(self) -> bool:
        """Whether a procedure runs."""
        return self._thread is not None and self._thread.is_alive()

    def step_joint(self, which: Joint, amount: float, goes_on: Callable[[], bool]) -> None:
        """Step a joint; it begins when the machine is armed, and ends when ``goes_on`` says no.

        Raises:
            InputRefused: the joint cannot be stepped so.
        """
        test = StepTest(self.profile, self.profile_hash, which, amount, load("crane"), key=self.key)
        self._begin(f"step of the {which.name.lower()}", test, test.keys, goes_on, lambda: self._keep(test.result()))

    def calibrate(self, chosen: Collection[Joint], goes_on: Callable[[], bool]) -> None:
        """Calibrate the joints ``chosen``, without a survey.

        Raises:
            InputRefused: a joint has no room, or nothing to be tested by.
            InputRefused: its report could not be drawn.
        """
        if importlib.util.find_spec("matplotlib") is None:
            sentence = "the report of a calibration needs matplotlib; install timberhand[tools]"
            raise InputRefused("commission.no-plots", sentence)
        report = self.report()
        position = (math.nan,) * len(JOINTS) if report is None else report.position
        plan = make_plan(self.profile, position, surveyed=False, chosen=chosen)
        run = Calibration(self.profile, self.profile_hash, plan, load("crane"), key=self.key, patience_s=PATIENCE_S)
        self._begin("calibration", run, run.trace.keys, goes_on, lambda: self._write(run))

    def end(self, reason: str) -> None:
        """End what runs, smoothly."""
        if self._procedure is not None and self.busy:
            self._procedure.abort(reason)
            self._procedure.idle = self._procedure.idle or self._procedure.waiting is not None

    def state(self) -> dict[str, Any]:
        """Return the state for the page."""
        run, busy = self._procedure, self.busy
        page_state: dict[str, Any] = {"doing": self._doing, "busy": busy, "said": self._said, "failure": self._failure}
        page_state |= {"waiting": "", "share": 0.0, "left_s": None, "steps": self.steps, "found": self.found}
        if run is not None and busy:
            page_state["waiting"] = run.waiting or ""
            if isinstance(run, Calibration):
                at, tasks = run.progress
                page_state |= {"share": at / tasks, "left_s": round(run.remaining_s()), "said": task_name(run.task)}
            elif isinstance(run, StepTest):
                page_state["share"] = round(run.progress, 3)
        return page_state

    def _begin(
        self,
        doing: str,
        run: Procedure,
        keys: tuple[int, ...],
        goes_on: Callable[[], bool],
        finish: Callable[[], str],
    ) -> None:
        with self._beginning:
            if self.busy:
                raise InputRefused("commission.busy", "something runs already; wait, or end it")
            self._doing, self._procedure, self._failure, self._said = doing, run, "", ""
            work = (run, keys, goes_on, finish)
            self._thread = threading.Thread(target=self._work, args=work, name="commissioning", daemon=True)
            self._thread.start()

    def _work(
        self, run: Procedure, keys: tuple[int, ...], goes_on: Callable[[], bool], finish: Callable[[], str]
    ) -> None:
        try:
            with (
                open_bus(self.bus, filters=keys, participant="commissioning") as bus,
                socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
            ):
                self._drive(run, bus, link, goes_on)
            if run.done:
                self._said = finish()
            self._failure = run.failure or ""
        except (LinkError, TimberhandError, OSError, ValueError) as error:
            self._failure = str(error)

    def _drive(self, run: Procedure, bus: Bus, link: socket.socket, goes_on: Callable[[], bool]) -> None:
        last, frames = None, list[Frame]()
        while not (run.idle or run.done):
            time.sleep(POLL_S)
            if not goes_on():
                self.end(LEASE_LOST)
            report = self.report()
            frames.clear()
            bus.drain(frames)
            data = run.step(time.monotonic_ns(), None if report is last else report, frames)
            last = report
            if data is not None:
                with contextlib.suppress(ConnectionRefusedError, BlockingIOError):
                    link.sendto(data, self.controller)

    def _keep(self, found: StepResult) -> str:
        self.steps[found.joint.name.lower()] = {
            "at": datetime.now(UTC).isoformat(timespec="seconds"),
            "amount": found.amount,
            "figures": {
                name: _known(getattr(found, name))
                for name in ("largest_error", "rest_error", "overshoot", "delay_s", "largest_command_pct")
            },
            "time_s": [_known(t) for t in found.time_s.tolist()],
            "series": {name: [_known(v) for v in values.tolist()] for name, values in found.series.items()},
        }
        return "The step is made."

    def _write(self, run: Calibration) -> str:
        result = identify(self.profile, run.found)
        changed = profile_changes(self.profile, result)
        now = datetime.now(UTC)
        name = f"{self.profile.name}-{now:%Y%m%dT%H%M%SZ}"
        facts: dict[str, Any] = {"profile": self.profile.name, "date": f"{now:%Y-%m-%d}", "seconds": run.elapsed_s}
        facts["repeated_tests"] = run.resumptions
        self.folder.mkdir(parents=True, exist_ok=True)
        write_report(self.folder / name, result, facts, changed)
        plots = sorted(path.name for path in (self.folder / name).glob("*.png"))
        self.found = {"name": name, "plots": plots, "changes": _before_and_after(self.source, changed)}
        if result.implausible:
            problems = " ".join(problem.sentence for problem in result.implausible)
            raise InputRefused("calibration.implausible", f"No profile is written: {problems}")
        write_profile(self.source, self.folder / f"{name}.toml", changed, facts["date"])
        again = f" Tests repeated after a stop: {run.resumptions}." if run.resumptions else ""
        return f"{name}.toml is written, with {len(changed)} new values; its report is the folder beside it.{again}"


def _before_and_after(source: Path, changed: Sequence[Change]) -> list[dict[str, Any]]:
    """List each changed value with the one that the profile's file has; None where it has none."""
    document = tomllib.loads(source.read_text(encoding="utf-8"))
    comparisons = []
    for path, value, remark in changed:
        before: Any = document
        for key in path:
            before = before.get(key) if isinstance(before, dict) else None
        comparisons.append({"key": ".".join(path), "before": before, "after": value, "remark": remark})
    return comparisons


def _known(value: float) -> float | None:
    return round(value, DECIMALS) if math.isfinite(value) else None
