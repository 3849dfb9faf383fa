"""The vcan lab: the choice of its method and of its clock, its kernel, the order to its guest, interface names."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import host.vcan_lab.__main__ as lab_command
from host.vcan_lab import choose as method
from host.vcan_lab import guest, uml
from host.vcan_lab.choose import MAX_GAP_NS, MAX_LOST_SHARE, HostFacts, LostTime, Method, choose, choose_clock
from host.vcan_lab.spec import DEFAULT_MEM_MB, LabError, Request, kernel_arguments, link_fault, order
from tests.codes import coded
from tests.host.vcan_request import REQUEST
from timberhand.commands.runs import DETECTOR_MEM_MB, Backend, ClockChoice, enter_lab

BARE = HostFacts(
    can_fault="Address family not supported by protocol",
    existing_fault=None,
    namespace_fault=None,
    kernel="/usr/bin/linux.uml",
    architecture="x86_64",
)


CAN = replace(BARE, can_fault=None)
NO_LINKS = replace(CAN, existing_fault="vcan0: No such device")


@pytest.mark.parametrize(
    ("facts", "kind", "kernel"),
    [
        pytest.param(CAN, "existing", None, id="interfaces"),
        pytest.param(NO_LINKS, "namespace", None, id="vcan"),
        pytest.param(replace(NO_LINKS, namespace_fault="not permitted"), "uml", BARE.kernel, id="no namespace"),
        pytest.param(BARE, "uml", BARE.kernel, id="no CAN"),
    ],
)
def test_the_nearest_method_is_used(facts: HostFacts, kind: str, kernel: str | None) -> None:
    found = choose(facts)
    assert (found.kind, found.kernel) == (kind, kernel)


def test_a_requested_kernel_is_the_only_method() -> None:
    both = replace(CAN, lab_kernel="/cache/linux-own")
    assert choose(both, "lab").kernel == "/cache/linux-own"
    assert choose(both, "debian").kernel == BARE.kernel


@pytest.mark.parametrize(
    ("facts", "asked", "code", "words"),
    [
        (replace(BARE, kernel=None), (), "lab.no-uml", ("AF_CAN", "linux.uml", "apt-get install user-mode-linux")),
        (replace(BARE, architecture="aarch64", kernel=None), (), "lab.architecture", ()),
        (BARE, ("lab",), "lab.no-lab-kernel", ()),
    ],
    ids=["no method", "another processor", "no lab kernel"],
)
def test_without_a_method_one_sentence_names_the_reasons(
    facts: HostFacts, asked: tuple[str, ...], code: str, words: tuple[str, ...]
) -> None:
    with pytest.raises(LabError, check=coded(code)) as refused:
        choose(facts, *asked)
    assert all(word in str(refused.value) for word in words) and "\n" not in str(refused.value)


def test_only_a_cpu_with_amx_needs_the_shim() -> None:
    assert uml.needed("model\t: x\nflags\t\t: fpu amx_tile avx\nbugs\t: y\n")
    assert not uml.needed("flags\t\t: fpu avx512f\nbugs\t: amx_tile\n")
    assert not uml.needed("")


def test_without_a_compiler_the_shim_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LabError, check=coded("lab.no-compiler")):
        uml.library(tmp_path)


def test_kernel_workers_that_end_meanwhile_do_not_end_the_guest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernel workers come and go while the guest starts; one of twenty boots failed with status 4 for that."""
    for pid, name in ((13, "ksoftirqd/0"), (14, "kworker/0:1"), (16, "ksoftirqd/1")):
        (tmp_path / str(pid)).mkdir()
        (tmp_path / str(pid) / "comm").write_text(f"{name}\n")
    (tmp_path / "15").mkdir()
    (tmp_path / "15" / "comm").symlink_to("gone")
    prioritized = []

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        if pid == 13:
            raise ProcessLookupError
        prioritized.append((pid, policy, param.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    guest.prioritize_soft_interrupts(tmp_path)
    assert prioritized == [(16, os.SCHED_FIFO, guest.SOFT_INTERRUPT_PRIORITY)]


# -- the clock

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


@pytest.fixture
def entered(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """How the lab was entered, on a quiet computer with a user-mode kernel."""
    found: list[dict[str, Any]] = []
    monkeypatch.delenv("TIMBERHAND_LAB", raising=False)
    monkeypatch.setattr(lab_command, "vcan", lambda words, **more: found.append(more))
    monkeypatch.setattr(method, "choose", lambda *_: Method("uml", "no CAN", "linux.uml"))
    monkeypatch.setattr(method, "measure", lambda: QUIET)
    monkeypatch.setattr(uml, "find", lambda _: KERNEL)
    return found


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
    entered: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["timberhand", "demo", "--bus", "vcan"])
    monkeypatch.setattr(method, "measure", lambda: lost)
    enter_lab(Backend.VCAN, choice)
    assert entered == [{"time_travel": simulated, "mem": DEFAULT_MEM_MB}]
    said = capsys.readouterr().err
    kind = "simulated" if simulated else "real"
    assert said.startswith(f"vcan lab: {kind} time: ") if choice is ClockChoice.AUTO else said == ""


def test_a_kernel_with_vcan_keeps_its_own_time(
    entered: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(method, "choose", lambda *_: Method("existing", "up"))
    enter_lab(Backend.VCAN)
    assert entered == [{"time_travel": False, "mem": DEFAULT_MEM_MB}] and capsys.readouterr().err == ""


def test_a_detector_gets_more_memory_and_simulated_time(entered: list[dict[str, Any]]) -> None:
    enter_lab(Backend.VCAN, detects=True)
    assert entered == [{"time_travel": True, "mem": DETECTOR_MEM_MB}] and DETECTOR_MEM_MB > DEFAULT_MEM_MB


# -- the order


def test_the_order_contains_the_caller_and_the_lab() -> None:
    text = order(REQUEST, "uml", new_links=True)
    assert text["user"] == [1000, 100, [100, 4]]
    assert text["links"] == ["vcan0", "vcan1"]
    assert text["env"] == {"A": "b", "TIMBERHAND_LAB": "uml", "XDG_RUNTIME_DIR": "/dev/runtime"}
    assert not text["host_shm"]
    assert order(replace(REQUEST, root=True), "uml", new_links=True)["user"] is None
    assert order(REQUEST, "native", new_links=False)["links"] == [], "existing interfaces are not created again"


@pytest.mark.parametrize(
    ("request_", "needed"),
    [
        (replace(REQUEST, cwd="/dev/shm/x"), []),
        (replace(REQUEST, argv=("ls", "/dev/shm")), []),
        (replace(REQUEST, env={"TMPDIR": "/dev/shm/t"}), []),
        (REQUEST, ["/dev/shm/venv"]),
    ],
)
def test_needed_files_in_shared_memory_stay_visible(request_: Request, needed: list[str]) -> None:
    assert order(request_, "uml", True, needed)["host_shm"]


def test_an_odd_path_stays_one_word_of_the_kernel_command_line() -> None:
    arguments = kernel_arguments("/a b/python", "/c d", REQUEST, 5, 6, 7)
    assert 'init="/a b/python"' in arguments
    assert arguments[-1] == '"/c d"'
    assert {"mem=256M", "con1=null,fd:5", "con2=null,fd:6", "con3=fd:7"} <= set(arguments)
    assert arguments.index("--") > arguments.index('init="/a b/python"')


def test_simulated_time_begins_at_the_same_instant_in_every_run() -> None:
    wanted = {"time-travel=inf-cpu", "time-travel-start=1767225600000000000"}
    assert not wanted & set(kernel_arguments("/python", "/", REQUEST, 5, 6, 7))
    arguments = kernel_arguments("/python", "/", replace(REQUEST, time_travel=True), 5, 6, 7)
    assert wanted <= set(arguments[: arguments.index("--")])


def test_a_path_with_a_quote_is_refused() -> None:
    with pytest.raises(LabError, check=coded("lab.path")):
        kernel_arguments('/a"b/python', "/", REQUEST, 5, 6, 7)


@pytest.mark.parametrize("name", ["", "sixteen-letters-", "a b", "a/b", "a:b", ".."])
def test_an_impossible_interface_name_is_refused(name: str) -> None:
    assert link_fault(name) and link_fault("fifteen-letters") is None
