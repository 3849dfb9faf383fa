"""Kept recordings replay to the same bytes: the controller decides as it did.

`tests/recordings` holds the first seconds of two lockstep runs: a crane on a fixed base (palms_471: start-up, arming,
the first motion) and a forwarder on both buses (aoro_fc8: start-up, driving, a search), with the profiles of commit
7d68e2e, which lie beside them.  A change of a database or of the law wants new ones::

    timberhand demo --lockstep --profile tests/recordings/palms.toml --limit-s 8
    timberhand mission run docs/examples/paper_b.geojson --lockstep --profile tests/recordings/aoro.toml --limit-s 8
"""

from __future__ import annotations

import lzma
from pathlib import Path

import pytest

from hil.replay.recording import PROFILE_FILE, files_of
from hil.replay.replay import replay

RECORDINGS = Path(__file__).resolve().parents[1] / "recordings"


@pytest.mark.parametrize(("name", "ticks"), [("palms", 1600), ("aoro", 2200)])
def test_a_kept_recording_replays_byte_for_byte(name: str, ticks: int, tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    run.write_bytes(lzma.decompress((RECORDINGS / f"{name}.mcap.xz").read_bytes()))
    (tmp_path / PROFILE_FILE).write_bytes((RECORDINGS / f"{name}.toml").read_bytes())
    result = replay(files_of(run))
    assert result.agrees, result
    assert result.ticks == ticks
