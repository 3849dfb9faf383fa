"""A whole machine in virtual time whose inputs are lost: it blames what was at fault, and `timberhand why` tells it."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from hil.demo import lockstep
from hil.demo.summary import Summary
from hil.faults.table import parse
from hil.wire.faults import Fault, Kind
from machine.status.reasons import Reason
from tests.codes import numbers_in
from timberhand.cli import app

pytestmark = pytest.mark.long
BEGIN_NS = 6_000_000_000
SEED = 7


@pytest.fixture
def disturbed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs the job with faults of the bus or of a process; gives the summary and the stops of `timberhand why`."""
    begin = lockstep._Job.run

    def run(faults: tuple[Fault, ...], limit_s: float, screen: Console, stalled: str = "") -> tuple[Summary, dict]:
        def inject(job: lockstep._Job, limit_s: float, directory: str) -> object:
            for fault in faults:
                job.system.core.inject(fault)
            return begin(job, limit_s, directory)

        monkeypatch.setattr(lockstep._Job, "run", inject)
        orders = [parse(stalled, SEED)] if stalled else []
        summary = lockstep.run_lockstep("palms_471", SEED, "nominal", tmp_path, limit_s, screen, orders=orders)
        told = CliRunner().invoke(app, ["why", str(tmp_path), "--json"], catch_exceptions=False)
        assert told.exit_code == 0
        return summary, json.loads(told.stdout)["stops"]

    return run


def lost(length_ms: int, key: int = 0, mask: int = 0) -> Fault:
    """Frames that do not arrive."""
    return Fault(Kind.DROP, BEGIN_NS, BEGIN_NS + length_ms * 1_000_000, key=key, mask=mask)


@pytest.mark.parametrize(
    ("stalled", "faults", "reason"),
    [
        pytest.param("process-stuck/controller@6s+30ms", (), Reason.COMPUTER_STALLED, id="stalled loop"),
        pytest.param("", (lost(30),), Reason.INPUTS_LOST, id="stalled wire"),
    ],
)
def test_the_stop_blames_what_was_at_fault(disturbed: Any, stalled: str, faults: tuple, reason: Reason) -> None:
    _, stops = disturbed(faults, 8.0, Console(file=io.StringIO()), stalled)
    assert stops[0]["code"] == reason.name


def test_the_stop_for_a_cut_cable_is_explained_and_the_operator_goes_on(tmp_path: Path, disturbed: Any) -> None:
    screen = Console(file=io.StringIO(), width=200)
    cut = lost(400, load("crane").message("EncLift").key, 0x7FF)
    summary, (stop,) = disturbed((cut,), 14.0, screen)
    summary.show(screen)
    assert (stop["code"], stop["detail"], stop["mode_before"]) == ("ENCODER_LOST", 1, "ACTIVE")
    assert BEGIN_NS < stop["monotonic_ns"] < BEGIN_NS + 40_000_000
    texts = [event["text"] for event in stop["events"]]
    for expected in ("ACTIVE → STOP: ENCODER_LOST", "STOP → FAULT", "RESET", "ARM"):
        assert any(text.endswith(expected) for text in texts), texts
    silent, _back = (text for text in texts if "EncLift" in text)
    assert 15 in numbers_in(silent)
    shown = screen.file.getvalue()  # type: ignore[attr-defined]
    assert f"STOP: {stop['text']}" in shown, "the terminal shows the same text"
    assert f"timberhand why {tmp_path}" in shown
