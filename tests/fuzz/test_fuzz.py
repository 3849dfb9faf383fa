"""A short run of every target, the inputs that once broke one, and the fuzzer itself."""

from __future__ import annotations

import pytest

from can_dbc.messages.envelope import DatagramRefused, unsealed
from tests.codes import numbers_in
from tests.fuzz.__main__ import TARGETS
from tests.fuzz.engine import FOREVER, REGRESSIONS, Broken, Target, fuzz, judged, packed, replay, smallest, unpacked

RUNS = {
    "controller-loader": 120,
    "controller-forwarder": 80,
    "guard": 300,
    "dbc": 60,
    "profile": 60,
    "guard-profile": 60,
    "guard-envelope": 100,
    "guard-dbc": 300,
    "trace-asc": 300,
    "recording": 600,
    "mission-file": 1000,
    "timing-page": 1500,
    "trace-decoded": 300,
}
SAVED = [(path.parent.name, path) for path in sorted(REGRESSIONS.glob("*/*.inputs"))]


@pytest.mark.parametrize("name", TARGETS)
def test_a_short_run_holds_the_contract(name: str) -> None:
    result = fuzz(TARGETS[name], seed=2, runs=RUNS.get(name, 3000))
    assert not result.failure, f"{result.failure}; inputs: {packed(result.inputs)[-400:]!r}"
    assert result.units > 0 and result.outcomes > 1


@pytest.mark.parametrize(("name", "path"), SAVED, ids=[f"{name}-{path.stem}" for name, path in SAVED])
def test_an_input_that_once_broke_a_contract(name: str, path: object) -> None:
    replay(TARGETS[name], unpacked(path.read_bytes()))  # type: ignore[attr-defined]


def _target(run, *seeds: bytes) -> Target:
    return Target("made", "inputs", lambda: run, lambda: seeds)


def _fragile(limit: int = FOREVER) -> Target:
    def start():
        count = 0

        def run(data: bytes) -> object:
            nonlocal count
            count += 1
            if b"\xff\xff" in data and count > 1:
                raise KeyError("an undocumented exception")
            try:
                unsealed(data, None)
            except DatagramRefused as refused:
                return refused.fault
            return "good"

        return run

    return Target("fragile", "inputs", start, lambda: [b"TRHD" + bytes(40)], runs_per_state=limit)


def test_the_fuzzer_finds_an_undocumented_exception_and_makes_its_inputs_small() -> None:
    target = _fragile(500)
    result = fuzz(target, runs=50_000)
    assert "KeyError" in result.failure
    small = smallest(target, result.inputs)
    assert len(small) == 2 and small[-1] == b"\xff\xff"
    with pytest.raises(Broken, match="KeyError"):
        replay(target, unpacked(packed(small)))


def test_the_same_seed_gives_the_same_run_and_another_one_does_not() -> None:
    def failing(seed: int) -> list[bytes]:
        return fuzz(_fragile(500), seed, runs=50_000).inputs

    assert failing(1) == failing(1) != failing(3)


def test_a_hang_is_a_broken_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.engine.HANG_S", 0.05)

    def hangs(data: bytes) -> object:
        while True:
            pass

    assert fuzz(_target(hangs, b""), runs=1).failure
    assert judged(lambda data: data, b"x") == b"x"


@pytest.mark.parametrize("hidden", [False, True])
def test_an_input_that_takes_much_memory_is_a_broken_contract(hidden: bool) -> None:
    def takes(data: bytes) -> object:
        if not data.startswith(b"bomb"):
            return 0
        try:
            return len(bytes(1000 << 20))
        except MemoryError:
            if not hidden:
                raise
            return len(b"x" * (300 << 20))

    target = _target(takes, b"", b"bomb")
    assert fuzz(target, runs=1).failure == "" and fuzz(target, runs=2).failure


def test_a_result_that_grows_memory_is_a_broken_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.engine.GROWTH_BYTES", 1 << 20)
    kept: list[bytes] = []

    def grows(data: bytes) -> object:
        kept.append(b"x" * (1 << 14))  # written, and more than a test before can have left free
        return 0

    found = fuzz(_target(grows, b"x"), runs=6000)
    assert found.failure and found.grown_bytes >> 20 in numbers_in(found.failure)
