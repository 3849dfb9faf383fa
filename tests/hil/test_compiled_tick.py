"""The interpreter is the reference: the compiled tick gives the same bytes on recorded and on random ticks."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.dbc.codec import load
from hil.tick.compare import compare_cost, compare_random, kept_recordings
from hil.tick.random_ticks import RandomTicks
from hil.tick.worker import recorded
from host.compiled.build import check_tools, compile_tick
from host.exit_codes import CommandFailed

DATABASES = load("crane"), load("machine"), load("gnss")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {path.parent.name: path for path in kept_recordings(tmp_path_factory.mktemp("kept"))}


@pytest.fixture(scope="module")
def build() -> str:
    """The key of a build for the present sources; compiles when there is none."""
    try:
        check_tools()
    except CommandFailed as missing:
        pytest.skip(str(missing))
    return str(compile_tick(print)["key"])


def test_random_ticks_are_the_same_for_the_same_seed_and_reach_a_driving_machine(recordings: dict[str, Path]) -> None:
    _, ticks = recorded(recordings["aoro"], 300)
    a, b, other = (RandomTicks(ticks, DATABASES, seed) for seed in (1, 1, 2))
    passes = [[list(supply.one_pass()) for _ in range(6)] for supply in (a, b, other)]
    assert passes[0] == passes[1] != passes[2]
    assert any(tick.late_ns != before.late_ns for tick, before in zip(passes[0][0], ticks, strict=True)) or any(
        one != ticks for one in passes[0]
    )


@pytest.mark.long
@pytest.mark.timeout(900)
def test_kept_recordings_replay_to_the_same_bytes_compiled(recordings: dict[str, Path], build: str) -> None:
    for path in recordings.values():
        found = compare_cost(path, 0, 1, print)
        assert found["compiled"]["tick"] == f"compiled {build}" and found["interpreter"]["tick"] == "interpreter"
        assert found["compiled"]["differing"] == found["interpreter"]["differing"] == 0


@pytest.mark.long
@pytest.mark.timeout(900)
def test_long_random_runs_agree_on_both_machines(recordings: dict[str, Path], build: str) -> None:
    for path in recordings.values():
        found = compare_random(path, 7, 4000, print)
        assert found["differs_after"] is None and found["ticks"] >= 4000
        assert "ACTIVE" in found["modes"], found["modes"]
