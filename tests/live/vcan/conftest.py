"""Live bus tests: they run inside the vcan lab (``timberhand hil vcan -- pytest tests/live/vcan``)."""

from __future__ import annotations

import os

import pytest

collect_ignore = ["test_time_travel.py"] if "TIMBERHAND_LAB" in os.environ else []
"""It starts labs itself, and user-mode Linux does not run in user-mode Linux."""


@pytest.fixture(autouse=True)
def _in_the_lab() -> None:
    if "TIMBERHAND_LAB" not in os.environ:
        pytest.skip("runs in the vcan lab: timberhand hil vcan -- pytest tests/live/vcan")
