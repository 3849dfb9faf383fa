"""``timberhand inject``: what it lists, refuses, and does to a live run."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.faults.live import LiveTarget, inject
from hil.faults.table import FAULTS, make
from hil.harness.live import ADDRESSES
from host.exit_codes import CommandFailed
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused
from tests.codes import coded
from tests.operator_end import udp_end
from timberhand.cli import app

PALMS = load_profile("palms_471")


def target(**changed: Any) -> LiveTarget:
    parts: dict[str, Any] = {"ports": {"sim": 1, "control": 1}, "buses": {"crane0": "socketcan:can0"}, "pids": {}}
    parts["key_file"] = Path("/nowhere/key")
    return LiveTarget(PALMS, **(parts | changed))


def test_the_list_shows_every_fault() -> None:
    result = CliRunner().invoke(app, ["inject", "--list"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    assert all(name in result.stdout for name in FAULTS)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["no-such-fault"], "fault.unknown"),
        (["encoder-lift", "off"], "fault.unknown-word"),
        (["encoder-lift", "stuck", "--at", "soon"], "fault.time-syntax"),
        (["encoder-stuck", "--run", "/nonexistent"], "fault.no-live-run"),
        (["planner-nan", "--run", "."], "fault.no-live-run"),
    ],
)
def test_what_cannot_be_injected_is_one_sentence_with_a_code(arguments: list[str], code: str) -> None:
    result = CliRunner().invoke(app, ["inject", *arguments])
    assert isinstance(result.exception, CommandFailed) and result.exception.code == code


def test_a_real_bus_is_left_alone() -> None:
    for order, code in (
        (make("bus-babble", length_s=0.01), "fault.real-bus"),
        (make("bus-cut"), "fault.only-on-wire"),
        (make("planner-nan"), "fault.not-live"),
        (make("process-off"), "fault.no-process"),
    ):
        with pytest.raises(InputRefused, check=coded(code)):
            inject(order, target())


def test_the_plant_is_asked_and_its_refusal_is_passed_on(tmp_path: Path) -> None:
    with udp_end(10) as plant:
        asked: list[dict[str, str]] = []

        def answer() -> None:
            for reply in ({"ok": True}, {"error": "no such encoder"}):
                data, sender = plant.recvfrom(4096)
                asked.append(json.loads(data))
                plant.sendto(json.dumps(reply).encode(), sender)

        thread = threading.Thread(target=answer)
        thread.start()
        document = {"profile": "palms_471", "ports": {"sim": plant.getsockname()[1]}, "buses": {}, "pids": {}}
        document["key_file"] = "key"
        (tmp_path / ADDRESSES).write_text(json.dumps(document))
        there = LiveTarget.of(tmp_path)
        assert "encoder-stuck" in inject(make("encoder-lift", "stuck", length_s=0.5), there)
        with pytest.raises(InputRefused, check=coded("fault.plant-refuses")):
            inject(make("encoder-stuck"), there)
        thread.join()
    fault = {"name": "encoder-stuck", "part": "lift", "size": "0.0", "seed": "0", "for_s": "0.5"}
    assert asked[0] == {"op": "fault"} | fault
