"""A whole machine in virtual time loses an encoder: its stop file tells why, and so does `timberhand why`."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from hil.demo import lockstep
from hil.wire.faults import Fault, Kind
from host.exit_codes import ExitCode
from tests.codes import numbers_in
from timberhand.cli import app

pytestmark = pytest.mark.long
LOST_NS = (6_000_000_000, 6_400_000_000)


def test_the_stop_of_a_demo_is_explained_and_the_operator_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = lockstep._Job.run

    def with_a_cut_cable(job: lockstep._Job, limit_s: float, directory: str) -> object:
        encoder = load("crane").message("EncLift").key
        job.system.core.inject(Fault(Kind.DROP, *LOST_NS, key=encoder, mask=0x7FF))
        return begin(job, limit_s, directory)

    monkeypatch.setattr(lockstep._Job, "run", with_a_cut_cable)
    screen = Console(file=io.StringIO(), width=200)
    summary = lockstep.run_lockstep("palms_471", 7, "nominal", tmp_path / "run", 14.0, screen)
    summary.show(screen)
    told = CliRunner().invoke(app, ["why", str(tmp_path / "run"), "--json"], catch_exceptions=False)
    assert told.exit_code == ExitCode.OK
    (stop,) = json.loads(told.stdout)["stops"]
    assert (stop["code"], stop["detail"], stop["mode_before"]) == ("ENCODER_LOST", 1, "ACTIVE")
    assert LOST_NS[0] < stop["monotonic_ns"] < LOST_NS[0] + 40_000_000
    texts = [event["text"] for event in stop["events"]]
    for expected in ("ACTIVE → STOP: ENCODER_LOST", "STOP → FAULT", "RESET", "ARM"):
        assert any(text.endswith(expected) for text in texts), texts
    silent, _back = (text for text in texts if "EncLift" in text)
    assert 15 in numbers_in(silent)
    shown = screen.file.getvalue()  # type: ignore[attr-defined]
    assert f"STOP: {stop['text']}" in shown, "the terminal shows the same text"
    assert f"timberhand why {tmp_path / 'run'}" in shown
