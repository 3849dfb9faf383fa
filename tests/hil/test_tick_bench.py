"""The judge of `timberhand bench tick`: intervals and verdicts, the other release, and the compiled tick."""

from __future__ import annotations

import math
import random
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from can_dbc.dbc.codec import load
from hil.tick import counted, release
from hil.tick.compare import compare_cost, compare_random, compared, kept_recordings, median_interval, verdict
from hil.tick.random_ticks import RandomTicks
from hil.tick.worker import recorded
from host.exit_codes import CommandFailed
from tests.codes import coded
from tests.hil.compiled_tick import build_key
from timberhand.cli import app


def test_the_interval_holds_the_median_as_often_as_it_says() -> None:
    rng = random.Random(1)
    held = 0
    for _ in range(2000):
        low, high = median_interval([math.exp(rng.gauss(0, 1)) for _ in range(9)])
        held += low <= 1.0 <= high
    assert 0.95 <= held / 2000 < 0.985


@pytest.mark.parametrize("n", range(6))
def test_fewer_than_six_rounds_bound_nothing(n: int) -> None:
    assert median_interval([3.0] * n) == (0.0, math.inf)


def test_six_rounds_give_their_range_and_one_wild_round_of_nine_does_not_count() -> None:
    assert median_interval([6.0, 1.0, 2.0, 3.0, 4.0, 5.0]) == (1.0, 6.0)
    assert median_interval([1000.0, *[2.0] * 8]) == (2.0, 2.0)


def test_a_limit_inside_the_interval_is_inconclusive() -> None:
    assert [verdict(interval, 2.0) for interval in ((2.0, 3.0), (1.0, 1.9), (1.9, 2.1), (0.0, math.inf))] == [
        "reached",
        "missed",
        "inconclusive",
        "inconclusive",
    ]


def test_ratios_are_those_of_the_same_round() -> None:
    slow, fast = [10.0, 20.0, 40.0, 10.0, 20.0, 40.0], [5.0, 10.0, 20.0, 5.0, 10.0, 20.0]
    found = compared(slow, fast, 2.0)
    assert (found["ratio"], found["low"], found["high"], found["verdict"]) == (2.0, 2.0, 2.0, "reached")


def test_a_wheel_is_unpacked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "source_root", lambda: tmp_path)
    with zipfile.ZipFile(tmp_path / "a.whl", "w") as wheel:
        wheel.writestr("controller/step.py", "")
    first = release.release(str(tmp_path / "a.whl"), print)
    assert first.name == "a.whl" and (first.folder / "controller" / "step.py").is_file()
    assert release.release(str(tmp_path / "a.whl"), print) == first
    assert [path.name for path in (tmp_path / "build" / "against").iterdir()] == [first.folder.name]


def test_what_valgrind_counted_is_told_for_one_tick():
    told = "==7== Events    : Ir Dr Dw I1mr D1mr D1mw ILmr DLmr DLmw\n==7== Collected : 2000 5 5 5 5 5 100 60 40\n"
    found = counted._per_tick('{"tick": "compiled x", "counted": 20}', told)
    assert found == {"ticks": 20, "instructions": 100, "code_lines": 5, "read_lines": 3, "written_lines": 2}
    with pytest.raises(CommandFailed, check=coded("tick.not-counted")):
        counted._per_tick('{"tick": "interpreter", "counted": 20}', told.replace("2000", "0"))
    with pytest.raises(CommandFailed, check=coded("tick.not-counted")):
        counted._per_tick("", "valgrind: command not found")


@pytest.mark.parametrize("other", ["--count", "--random=10"])
def test_an_option_that_would_be_ignored_is_refused(other: str) -> None:
    done = CliRunner().invoke(app, ["bench", "tick", other, "--against", "HEAD"])
    assert done.exit_code == 2 and "--against" in done.output


# -- the interpreter is the reference: the compiled tick gives the same bytes on recorded and on random ticks

DATABASES = load("crane"), load("machine"), load("gnss")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {path.parent.name: path for path in kept_recordings(tmp_path_factory.mktemp("kept"))}


@pytest.fixture(scope="module")
def build() -> str:
    return build_key()


def test_random_ticks_are_the_same_for_the_same_seed_and_not_the_recorded_ones(recordings: dict[str, Path]) -> None:
    _, ticks = recorded(recordings["aoro"], 300)
    a, b, other = (RandomTicks(ticks, DATABASES, seed) for seed in (1, 1, 2))
    passes = [[list(supply.one_pass()) for _ in range(6)] for supply in (a, b, other)]
    assert passes[0] == passes[1] != passes[2]
    assert any(one != ticks for one in passes[0])


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
