"""The clock of a live run in user-mode Linux: measured, chosen, announced."""

from __future__ import annotations

import sys
from typing import Any

import pytest

import host.vcan_lab.__main__ as lab_command
from host.vcan_lab import choose, uml
from host.vcan_lab.choose import MAX_GAP_NS, MAX_LOST_SHARE, LostTime, Method, choose_clock
from host.vcan_lab.spec import DEFAULT_MEM_MB
from timberhand.commands.runs import DETECTOR_MEM_MB, Backend, ClockChoice, enter_lab

QUIET = LostTime(0.01, 2_000_000, 0.0)
KERNEL = "/cache/linux"


@pytest.mark.parametrize(
    ("lost", "kernel", "kind", "enough"),
    [
        (QUIET, KERNEL, "real", True),
        (QUIET, None, "real", True),
        (LostTime(MAX_LOST_SHARE + 0.01, 2_000_000, 0.0), KERNEL, "simulated", True),
        (LostTime(0.02, MAX_GAP_NS + 1, 0.02), KERNEL, "simulated", True),
        (LostTime(0.5, 60_000_000, 0.4), None, "real", False),
    ],
)
def test_a_host_that_takes_too_much_gets_simulated_time(
    lost: LostTime, kernel: str | None, kind: str, enough: bool
) -> None:
    chosen = choose_clock(lost, kernel)
    assert (chosen.kind, chosen.enough) == (kind, enough)
    assert lost.words() in chosen.reason
    assert enough or uml.MISSING in chosen.reason


@pytest.mark.parametrize(("kernel", "kind", "enough"), [(KERNEL, "simulated", True), (None, "real", False)])
def test_a_camera_s_detector_gets_simulated_time_on_the_quietest_host(
    kernel: str | None, kind: str, enough: bool
) -> None:
    chosen = choose_clock(QUIET, kernel, detects=True)
    assert (chosen.kind, chosen.enough) == (kind, enough)


@pytest.mark.parametrize(
    ("choice", "lost", "simulated"),
    [
        (ClockChoice.AUTO, QUIET, False),
        (ClockChoice.AUTO, LostTime(0.4, 1, 0.0), True),
        (ClockChoice.REAL, LostTime(0.4, 1, 0.0), False),
        (ClockChoice.SIMULATED, QUIET, True),
    ],
)
def test_the_command_enters_the_lab_with_that_clock_and_says_so(
    choice: ClockChoice,
    lost: LostTime,
    simulated: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    entered: list[tuple[list[str], dict[str, Any]]] = []
    monkeypatch.delenv("TIMBERHAND_LAB", raising=False)
    monkeypatch.setattr(sys, "argv", ["timberhand", "demo", "--bus", "vcan"])
    monkeypatch.setattr(lab_command, "vcan", lambda words, **more: entered.append((words, more)))
    monkeypatch.setattr(choose, "choose", lambda *_: Method("uml", "no CAN", "linux.uml"))
    monkeypatch.setattr(uml, "find", lambda _: KERNEL)
    monkeypatch.setattr(choose, "measure", lambda: lost)
    enter_lab(Backend.VCAN, choice)
    assert [more for _, more in entered] == [{"time_travel": simulated, "mem": DEFAULT_MEM_MB}]
    said = capsys.readouterr().err
    kind = "simulated" if simulated else "real"
    assert said.startswith(f"vcan lab: {kind} time: ") if choice is ClockChoice.AUTO else said == ""


def test_a_kernel_with_vcan_keeps_its_own_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entered: list[dict[str, Any]] = []
    monkeypatch.delenv("TIMBERHAND_LAB", raising=False)
    monkeypatch.setattr(lab_command, "vcan", lambda words, **more: entered.append(more))
    monkeypatch.setattr(choose, "choose", lambda *_: Method("existing", "up"))
    enter_lab(Backend.VCAN)
    assert entered == [{"time_travel": False, "mem": DEFAULT_MEM_MB}] and capsys.readouterr().err == ""


def test_a_detector_gets_more_memory_and_simulated_time(monkeypatch: pytest.MonkeyPatch) -> None:
    entered: list[dict[str, Any]] = []
    monkeypatch.delenv("TIMBERHAND_LAB", raising=False)
    monkeypatch.setattr(lab_command, "vcan", lambda words, **more: entered.append(more))
    monkeypatch.setattr(choose, "choose", lambda *_: Method("uml", "no CAN", "linux.uml"))
    monkeypatch.setattr(choose, "measure", lambda: QUIET)
    monkeypatch.setattr(uml, "find", lambda _: KERNEL)
    enter_lab(Backend.VCAN, detects=True)
    assert entered == [{"time_travel": True, "mem": DETECTOR_MEM_MB}] and DETECTOR_MEM_MB > DEFAULT_MEM_MB
