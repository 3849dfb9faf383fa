"""Campaigns: their table, kept trials, recordings of those that failed; and all experiments at once."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from experiments.common import campaign
from tests.experiments.toy_experiment import enter, options

QUIET = Console(quiet=True)


def test_the_table_is_the_same_by_one_process_two_and_in_two_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(monkeypatch)
    _, one = campaign.run("toy", options(tmp_path / "a"), 0, QUIET)
    _, two = campaign.run("toy", options(tmp_path / "b", workers=2), 0, QUIET)
    campaign.run("toy", options(tmp_path / "c", trials=2), 0, QUIET)
    _, continued = campaign.run("toy", options(tmp_path / "c"), 0, QUIET)
    assert one.table_sha256 == two.table_sha256 == continued.table_sha256
    tables = {(tmp_path / each / campaign.TABLE).read_bytes() for each in "abc"}
    assert tables == {b"".join(b'["n/%d", {"odd": 0, "square": %d}]\n' % (i, i * i) for i in range(4))}
    lines = (tmp_path / "c" / "trials.jsonl").read_text().splitlines()
    assert [json.loads(line)[0] for line in lines] == ["n/0", "n/1", "n/2", "n/3"], "no trial ran twice"


def test_the_summary_says_what_a_trial_costs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enter(monkeypatch)
    _, found = campaign.run("toy", options(tmp_path, workers=2), 0, QUIET)
    document = json.loads((tmp_path / campaign.SUMMARY).read_text())
    assert document["trials"] == 4 and document["table_sha256"] == found.table_sha256
    assert found.worker_bytes > 2**20 and found.table_bytes > 20.0 and math.isfinite(found.seconds)
