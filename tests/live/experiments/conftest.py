"""Experiments that run in the test's own process keep their workers for the next call; here they end with the test."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def workers_end(confined: None) -> Iterator[None]:
    """End joblib's workers."""
    yield
    if "joblib.externals.loky" in sys.modules:
        from joblib.externals.loky import reusable_executor

        if reusable_executor._executor is not None:
            reusable_executor._executor.shutdown(wait=True, kill_workers=True)
