"""Open pages of the console change no tick: it never waits for them, and does the same beside ten as beside none."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from timberhand.cli import app


@pytest.mark.timeout(400)
def test_a_tick_beside_open_pages_makes_the_same_calls_and_sends_the_same_frames() -> None:
    """The command, shortened; its times decide nothing in one round."""
    done = CliRunner().invoke(app, ["bench", "pages", "--rounds", "1", "--seconds", "2", "--json"])
    assert done.exit_code == 0, (done.output, done.exception)
    told = json.loads(done.stdout)
    assert told["states"] > 100 and told["counts"]["frames"]["same"] and told["counts"]["calls"]["same"] is not False
    assert told["cpu"]["verdict"] == "inconclusive" and told["environment"]["kernel"]
