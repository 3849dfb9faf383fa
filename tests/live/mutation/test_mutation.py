"""The mutator: which mutants it makes, that they differ, and that a kill is a kill."""

from __future__ import annotations

import sys
import time

import pytest

from tests.codes import numbers_in
from tests.mutation import runner
from tests.mutation.runner import Forks


@pytest.mark.parametrize(
    ("work", "code"),
    [(lambda pipe: 10, 10), (lambda pipe: 11, 11), (lambda pipe: sys.exit("away"), 1), (lambda pipe: 1 // 0, 1)],
    ids=["killed", "survived", "exit", "exception"],
)
def test_a_fork_reports_how_it_ended(work, code) -> None:
    forks = Forks(2)
    ended = [*forks.start("mutant", 5.0, work), *forks.finish()]
    assert [(what, status) for what, status, _ in ended] == [("mutant", code)]


def test_a_fork_without_end_is_a_time_out() -> None:
    def work(pipe: int) -> int:
        while True:
            pass

    forks = Forks(1)
    assert [status for _, status, _ in [*forks.start("mutant", 0.0, work), *forks.finish()]] == [None]


def test_a_fork_that_waits_for_nothing_is_a_time_out(monkeypatch) -> None:
    monkeypatch.setattr(runner, "IDLE_S", 1.0)
    forks = Forks(1)
    ended = [*forks.start("mutant", 5.0, lambda pipe: time.sleep(100.0) or 10), *forks.finish()]
    assert [(status, numbers_in(words)) for _, status, words in ended] == [(None, [1])]
