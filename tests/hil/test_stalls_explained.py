"""A whole machine in virtual time whose inputs are lost: what it blames is what was at fault."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from hil.demo import lockstep
from hil.faults.table import parse
from hil.wire.faults import Fault, Kind
from machine.status.reasons import Reason
from timberhand.cli import app

pytestmark = pytest.mark.long
LOST_NS = (6_000_000_000, 6_030_000_000)
SEED = 7


@pytest.mark.parametrize(
    ("stalled", "dropped", "reason"),
    [
        ("process-stuck/controller@6s+30ms", None, Reason.COMPUTER_STALLED),
        ("", (0, 0), Reason.INPUTS_LOST),
        ("", (load("crane").message("EncLift").key, 0x7FF), Reason.ENCODER_LOST),
    ],
    ids=["stalled loop", "stalled wire", "cut cable"],
)
def test_the_stop_blames_what_was_at_fault(
    stalled: str, dropped: tuple[int, int] | None, reason: Reason, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = lockstep._Job.run

    def disturbed(job: lockstep._Job, limit_s: float, directory: str) -> object:
        if dropped is not None:
            job.system.core.inject(Fault(Kind.DROP, *LOST_NS, key=dropped[0], mask=dropped[1]))
        return begin(job, limit_s, directory)

    monkeypatch.setattr(lockstep._Job, "run", disturbed)
    orders = [parse(stalled, SEED)] if stalled else []
    lockstep.run_lockstep("palms_471", SEED, "nominal", tmp_path, 8.0, Console(file=io.StringIO()), orders=orders)
    told = CliRunner().invoke(app, ["why", str(tmp_path), "--json"], catch_exceptions=False)
    assert json.loads(told.stdout)["stops"][0]["code"] == reason.name
