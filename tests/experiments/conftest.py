"""Results in these tests are of no commit: asking git would start a process."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _one_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.common.result.commit", lambda: "0123456789ab")
