"""The script that brings interfaces up, with an `ip` that records its arguments."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[3] / "deploy/system/can-up"
IP = """#!/bin/sh
echo "$*" >>"$LOG"
case "$*" in *" show "*) [ -z "$LINK" ] && exit 1; echo "$LINK"; exit 0 ;; esac
case " $REFUSES " in *" $5 "*) exit 2 ;; esac
"""
REAL: dict[str, Any] = {
    "ifname": "can0",
    "flags": ["NOARP"],
    "link_type": "can",
    "linkinfo": {"info_kind": "can", "info_data": {"restart_ms": 0, "bittiming": {"bitrate": 500000, "tq": 100}}},
}
RUNNING: dict[str, Any] = {
    "ifname": "can0",
    "flags": ["NOARP", "UP", "LOWER_UP"],
    "link_type": "can",
    "linkinfo": {"info_kind": "can", "info_data": {"restart_ms": 100, "bittiming": {"bitrate": 1000000, "tq": 50}}},
}
VIRTUAL: dict[str, Any] = {"ifname": "can0", "flags": ["NOARP"], "link_type": "can", "linkinfo": {"info_kind": "vcan"}}
SETTINGS = {"CRANE_BUS": "socketcan:can0", "CRANE_BITRATE": "1000000", "MACHINE_BUS": "", "CAN_WAIT_S": "0"}


@pytest.fixture
def can_up(tmp_path: Path):
    ip = tmp_path / "ip"
    ip.write_text(IP)
    ip.chmod(0o755)

    def run(bus: str, link: dict[str, Any] | None, pretty: bool = False, **settings: str):
        log = tmp_path / "log"
        log.write_text("")
        shown = json.dumps([link], **({"indent": 4} if pretty else {"separators": (",", ":")})) if link else ""
        env = {"PATH": f"{tmp_path}:{os.defpath}", "LOG": str(log), "LINK": shown} | SETTINGS | settings
        done = subprocess.run(["sh", str(SCRIPT), bus], env=env, capture_output=True, text=True, check=False)
        told = [line for line in log.read_text().splitlines() if " show " not in line]
        return done.returncode, told, done.stderr

    return run


@pytest.mark.parametrize("pretty", [False, True])
def test_a_real_interface_gets_bit_rate_restart_and_a_short_queue(can_up, pretty: bool) -> None:
    assert can_up("crane0", REAL, pretty) == (
        0,
        [
            "link set dev can0 down",
            "link set dev can0 type can bitrate 1000000 restart-ms 100",
            "link set dev can0 txqueuelen 32",
            "link set dev can0 up",
        ],
        "",
    )


def test_an_interface_is_set_up_for_python_can_as_for_our_own_socket(can_up) -> None:
    assert can_up("crane0", VIRTUAL, CRANE_BUS="python-can:socketcan:can0") == (0, ["link set dev can0 up"], "")


def test_a_correctly_configured_interface_is_left_alone(can_up) -> None:
    assert can_up("crane0", RUNNING) == (0, [], "")
    wrong = RUNNING | {"linkinfo": REAL["linkinfo"]}
    assert len(can_up("crane0", wrong)[1]) == 4


def test_bit_rates_with_a_common_prefix_are_distinguished(can_up) -> None:
    assert len(can_up("crane0", RUNNING, CRANE_BITRATE="100000")[1]) == 4


def test_a_virtual_interface_is_only_brought_up(can_up) -> None:
    assert can_up("crane0", VIRTUAL) == (0, ["link set dev can0 up"], "")
    assert can_up("crane0", VIRTUAL | {"flags": ["UP"]}) == (0, [], "")


@pytest.mark.parametrize("address", ["", "wire:crane0", "kvaser:0", "slcan:/dev/ttyUSB0"])
def test_an_address_outside_the_kernel_is_left_alone(can_up, address: str) -> None:
    assert can_up("crane0", None, CRANE_BUS=address) == (0, [], "")


@pytest.mark.parametrize(
    ("bus", "link", "settings", "status", "named"),
    [
        ("crane0", None, {}, 4, "can0"),
        ("crane0", REAL, {"REFUSES": "type"}, 4, "CRANE_BITRATE"),
        ("crane0", REAL, {"REFUSES": "up"}, 4, "ip -details link show can0"),
        ("crane0", REAL, {"CRANE_BITRATE": "fast"}, 3, "CRANE_BITRATE=fast"),
        ("crane0", {"ifname": "can0", "link_type": "ether"}, {}, 3, "can0"),
        ("crane0", REAL, {"CRANE_BUS": "can0"}, 3, "CRANE_BUS=can0"),
        ("mach0", None, {"MACHINE_BUS": "socketcan:can9"}, 4, "can9"),
        ("crane9", None, {}, 2, "crane9"),
    ],
)
def test_every_refusal_is_one_sentence(can_up, bus, link, settings, status, named) -> None:
    code, _, said = can_up(bus, link, **settings)
    assert code == status
    assert named in said
    assert said.count("\n") == 1


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is missing (apt-get install shellcheck)")
@pytest.mark.parametrize(
    "name",
    [
        "install.sh",
        "audit.sh",
        "system/can-up",
        "system/service-ended",
        "deb/build.sh",
        "deb/postinst",
        "deb/prerm",
        "../host/service_lab/init.sh",
    ],
)
def test_scripts_are_clean(name: str) -> None:
    subprocess.run(["shellcheck", str(SCRIPT.parents[1] / name)], check=True)
