"""The method of the vcan lab: the choice, the lab's own kernel, the shim."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from host.vcan_lab import guest, uml
from host.vcan_lab.choose import HostFacts, choose
from host.vcan_lab.spec import LabError
from tests.codes import coded

BARE = HostFacts(
    can_fault="Address family not supported by protocol",
    existing_fault=None,
    namespace_fault=None,
    kernel="/usr/bin/linux.uml",
    architecture="x86_64",
)


def test_existing_interfaces_are_used() -> None:
    assert choose(replace(BARE, can_fault=None)).kind == "existing"


def test_a_kernel_with_vcan_gets_a_namespace() -> None:
    method = choose(replace(BARE, can_fault=None, existing_fault="vcan0: No such device"))
    assert (method.kind, method.kernel) == ("namespace", None)


@pytest.mark.parametrize(
    "machine",
    [BARE, replace(BARE, can_fault=None, existing_fault="vcan0: No such device", namespace_fault="not permitted")],
)
def test_without_vcan_the_user_mode_kernel_is_used(machine: HostFacts) -> None:
    method = choose(machine)
    assert (method.kind, method.kernel) == ("uml", "/usr/bin/linux.uml")


def test_without_any_method_one_sentence_names_both_reasons() -> None:
    with pytest.raises(LabError, check=coded("lab.no-uml")) as refused:
        choose(replace(BARE, kernel=None))
    sentence = str(refused.value)
    assert "AF_CAN" in sentence and "linux.uml" in sentence and "apt-get install user-mode-linux" in sentence
    assert "\n" not in sentence


def test_there_is_no_user_mode_kernel_for_other_processors() -> None:
    with pytest.raises(LabError, check=coded("lab.architecture")):
        choose(replace(BARE, architecture="aarch64", kernel=None))


def test_a_requested_kernel_is_the_only_method() -> None:
    both = replace(BARE, can_fault=None, lab_kernel="/cache/linux-own")
    assert choose(both, "lab").kernel == "/cache/linux-own"
    assert choose(both, "debian").kernel == "/usr/bin/linux.uml"
    with pytest.raises(LabError, check=coded("lab.no-lab-kernel")):
        choose(BARE, "lab")


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
