"""The vcan lab's way to CAN on a machine: the choice, its own kernel, the shim."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from host.vcan_lab import guest, lab_kernel, shim
from host.vcan_lab.choose import Machine, choose
from host.vcan_lab.spec import LabError

BARE = Machine(
    can_fault="Address family not supported by protocol",
    existing_fault=None,
    namespace_fault=None,
    kernel="/usr/bin/linux.uml",
    architecture="x86_64",
)


def test_a_kernel_with_the_interfaces_up_is_used_as_it_is() -> None:
    assert choose(replace(BARE, can_fault=None)).kind == "existing"


def test_a_kernel_with_vcan_gets_a_namespace() -> None:
    way = choose(replace(BARE, can_fault=None, existing_fault="vcan0: No such device"))
    assert (way.kind, way.kernel) == ("namespace", None)


@pytest.mark.parametrize(
    "machine",
    [BARE, replace(BARE, can_fault=None, existing_fault="vcan0: No such device", namespace_fault="not permitted")],
)
def test_without_vcan_the_user_mode_kernel_is_taken(machine: Machine) -> None:
    way = choose(machine)
    assert (way.kind, way.kernel) == ("uml", "/usr/bin/linux.uml")


def test_without_any_way_one_sentence_names_both_reasons() -> None:
    with pytest.raises(LabError) as refused:
        choose(replace(BARE, kernel=None))
    sentence = str(refused.value)
    assert "no AF_CAN" in sentence
    assert "linux.uml is missing: apt-get install user-mode-linux" in sentence
    assert "\n" not in sentence


def test_the_user_mode_kernel_is_not_promised_to_other_processors() -> None:
    with pytest.raises(LabError, match="x86_64 only, this is aarch64"):
        choose(replace(BARE, architecture="aarch64", kernel=None))


def test_a_kernel_that_is_asked_for_is_the_only_way() -> None:
    both = replace(BARE, can_fault=None, lab_kernel="/cache/linux-own")
    assert choose(both, "lab").kernel == "/cache/linux-own"
    assert choose(both, "debian").kernel == "/usr/bin/linux.uml"
    with pytest.raises(LabError, match="make lab-kernel"):
        choose(BARE, "lab")


def test_only_a_kernel_of_the_present_configuration_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tmp_path / "lab.config"
    config.write_text("CONFIG_CAN=y\n")
    monkeypatch.setattr(lab_kernel, "CONFIG", config)
    recipe = subprocess.run(["sha256sum", config], capture_output=True, text=True, check=True).stdout[:12]
    assert lab_kernel.find(tmp_path) is None
    for number, name in enumerate([f"linux-6.12.2-{recipe}", f"linux-6.12.9-{recipe}", "linux-6.12.10-other"]):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (number, number))
    assert lab_kernel.find(tmp_path) == str(tmp_path / f"linux-6.12.9-{recipe}")
    config.unlink()
    assert lab_kernel.find(tmp_path) is None


def test_only_a_cpu_with_amx_needs_the_shim() -> None:
    assert shim.needed("model\t: x\nflags\t\t: fpu amx_tile avx\nbugs\t: y\n")
    assert not shim.needed("flags\t\t: fpu avx512f\nbugs\t: amx_tile\n")
    assert not shim.needed("")


def test_the_shim_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not any(Path(folder, "cc").exists() for folder in os.get_exec_path()):
        pytest.skip("no C compiler")
    built = shim.library(tmp_path / "cache")
    assert built.read_bytes().startswith(b"\x7fELF")
    monkeypatch.setenv("PATH", "/nowhere")
    assert shim.library(tmp_path / "cache") == built
    assert os.listdir(built.parent) == [built.name]


def test_without_a_compiler_a_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LabError, match="apt-get install gcc libc6-dev"):
        shim.library(tmp_path)


def test_workers_that_end_while_they_are_looked_at_do_not_end_the_guest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernel workers come and go while the guest starts; one of twenty boots ended with status 4 for that."""
    for pid, name in ((13, "ksoftirqd/0"), (14, "kworker/0:1"), (16, "ksoftirqd/1")):
        (tmp_path / str(pid)).mkdir()
        (tmp_path / str(pid) / "comm").write_text(f"{name}\n")
    (tmp_path / "15").mkdir()
    (tmp_path / "15" / "comm").symlink_to("gone")
    hastened = []

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        if pid == 13:
            raise ProcessLookupError
        hastened.append((pid, policy, param.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    guest.hasten_soft_interrupts(tmp_path)
    assert hastened == [(16, os.SCHED_FIFO, guest.SOFT_INTERRUPT_PRIORITY)]
