"""Live bus tests: they run inside the vcan lab (``timberhand hil vcan -- pytest tests/vcan``)."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def _in_the_lab() -> None:
    if "TIMBERHAND_LAB" not in os.environ:
        pytest.skip("runs in the vcan lab: timberhand hil vcan -- pytest tests/vcan")
