"""The look whether this computer holds the period of a live run: what is judged, and by which limit."""

from __future__ import annotations

import subprocess  # noqa: TID251  one of its exceptions
from typing import Any

import pytest

from can_dbc.dbc.codec import load
from host import lateness, real_time
from host.lateness import NEED
from host.real_time import BEARABLE_NS, SHORTEST_TIMEOUT_NS, STANDS_STILL, Finding, look, obstacle


def test_a_live_run_bears_half_of_the_shortest_time_out_of_an_input() -> None:
    shortest_ns = min(
        m.timeout_ns for name in ("crane", "machine") for m in load(name).messages.values() if m.timeout_ns
    )
    assert shortest_ns == SHORTEST_TIMEOUT_NS
    assert shortest_ns // 2 == BEARABLE_NS
    assert not obstacle(Finding(BEARABLE_NS, NEED, 0.0)) and obstacle(Finding(BEARABLE_NS + 1, NEED, 0.0))


def test_free_processors_are_counted_between_two_readings() -> None:
    before = [100, 0, 50, 1000, 10, 0, 0, 5]
    after = [150, 0, 50, 1048, 12, 0, 0, 5]  # 50 ticks of work, 50 of rest
    assert lateness.free(before, after, 4) == pytest.approx(2.0)


def test_what_a_host_took_is_a_share_of_the_time_with_work() -> None:
    assert lateness.stolen([900, 0, 90, 10**6, 10**5, 0, 0, 10]) == pytest.approx(0.01)
    assert lateness.stolen([0] * 8) == 0.0


def test_a_virtual_machine_that_loses_its_processors_now_and_then_does_not_hold_the_period() -> None:
    """A look of two seconds misses a standstill that comes every ten; the count since the start does not."""
    assert obstacle(Finding(0, 2.0, 0.0047))


def test_a_probe_that_does_not_come_to_its_end_is_a_computer_that_stands_still(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def silent(*_: Any, **__: Any) -> None:
        raise subprocess.TimeoutExpired("probe", 32.0)

    monkeypatch.setattr(real_time, "run_probe", silent)
    assert look() == STANDS_STILL and obstacle(STANDS_STILL)


class Computer:
    """Clocks of a computer that stands still once, while its process sleeps or while it works."""

    def __init__(self, still_at_ns: int, still_ns: int, asleep: bool) -> None:
        self.now_ns, self.used_ns = 1_000_000_000, 0
        self.still_at_ns, self.still_ns, self.asleep = self.now_ns + still_at_ns, still_ns, asleep

    def _stand_still(self) -> None:
        if self.now_ns >= self.still_at_ns:
            self.now_ns += self.still_ns
            self.still_ns = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def thread_time_ns(self) -> int:
        self.used_ns += 10_000
        self.now_ns += 10_000
        if not self.asleep:
            self._stand_still()
        return self.used_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)
        if self.asleep:
            self._stand_still()


@pytest.mark.parametrize("asleep", [True, False])
@pytest.mark.parametrize("still_ns", [0, 5_000_000, 34_000_000])
def test_the_probe_finds_the_longest_standstill_asleep_or_at_work(
    still_ns: int, asleep: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lateness, "time", Computer(50_300_000, still_ns, asleep))
    assert lateness.longest_ns(200_000_000, 250_000) == pytest.approx(still_ns, abs=100_000)


def test_the_probe_works_as_much_as_a_live_run_and_leaves_something() -> None:
    assert lateness.work_ns(1) == lateness.work_ns(2) == 750_000
    assert 10 * lateness.work_ns(10) == 1_500_000
