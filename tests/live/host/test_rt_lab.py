"""The control loop on Debian's PREEMPT_RT kernel, in qemu."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from host.rt_lab import host
from host.rt_lab.host import missing
from host.vcan_lab.spec import LabError
from tests.codes import coded
from tests.live.host.lab_runs import completed


@pytest.mark.timeout(700)
def test_the_control_loop_runs_on_a_real_time_kernel_and_the_valves_are_neutral_after_a_kill() -> None:
    if fault := missing():
        pytest.skip(f"rt lab: {fault}")
    try:
        host.kernel_package(lambda _line: None)
    except LabError as reason:
        pytest.skip(f"rt lab: {reason}")
    result = completed("host.rt_lab", 600)
    assert "PREEMPT_RT" in result["kernel"] and result["realtime"] == "1"
    assert result["refused"] == [] and result["controller_locked_kb"] > 0
    assert result["ticks"] > 100 and result["neutral_ms"] <= 100.0


def test_a_package_without_a_kernel_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.deb"
    (tmp_path / "build/DEBIAN").mkdir(parents=True)
    (tmp_path / "build/DEBIAN/control").write_text(
        "Package: other\nVersion: 1\nArchitecture: all\nMaintainer: Nobody <nobody@example.org>\nDescription: nothing\n"
    )
    try:
        subprocess.run(["dpkg-deb", "--build", tmp_path / "build", other], check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip("dpkg-deb is missing")
    with pytest.raises(LabError, check=coded("rt-lab.no-kernel")):
        host.unpack(other, tmp_path / "kernel")
