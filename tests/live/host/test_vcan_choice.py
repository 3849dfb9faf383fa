"""The method of the vcan lab: the choice, the lab's own kernel, the shim."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from host.vcan_lab import uml


def test_only_a_kernel_of_the_present_configuration_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tmp_path / "lab.config"
    config.write_text("CONFIG_CAN=y\n")
    monkeypatch.setattr(uml, "CONFIG", config)
    digest = subprocess.run(["sha256sum", config], capture_output=True, text=True, check=True).stdout[:12]
    assert uml.find(tmp_path) is None
    for number, name in enumerate([f"linux-6.12.2-{digest}", f"linux-6.12.9-{digest}", "linux-6.12.10-other"]):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (number, number))
    assert uml.find(tmp_path) == str(tmp_path / f"linux-6.12.9-{digest}")
    config.unlink()
    assert uml.find(tmp_path) is None


def test_the_shim_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not any(Path(folder, "cc").exists() for folder in os.get_exec_path()):
        pytest.skip("no C compiler")
    built = uml.library(tmp_path / "cache")
    assert built.read_bytes().startswith(b"\x7fELF")
    monkeypatch.setenv("PATH", "/nowhere")
    assert uml.library(tmp_path / "cache") == built
    assert os.listdir(built.parent) == [built.name]
