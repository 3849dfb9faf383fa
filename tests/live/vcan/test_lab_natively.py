"""The native methods of the lab, tested inside the lab, where the kernel has CAN and vcan."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(("link", "way"), [("vcan0", "existing"), ("nest0", "namespace")])
def test_a_kernel_with_can_needs_no_user_mode_kernel(link: str, way: str) -> None:
    command = ["sh", "-c", f'echo "$TIMBERHAND_LAB" $(cat); ip link show {link} >&2 && kill -HUP $$']
    done = subprocess.run(
        [sys.executable, "-m", "host.vcan_lab", "-v", "--link", link, "--", *command], capture_output=True, check=False
    )
    complaints = done.stderr.decode()
    assert (done.returncode, done.stdout) == (128 + 1, b"native\n"), complaints
    assert f"vcan lab: {way}" in complaints
    assert "UP" in complaints
    links = subprocess.run(["ip", "-brief", "link"], capture_output=True, text=True, check=True).stdout
    assert "nest0" not in links
