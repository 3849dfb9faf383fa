"""The vcan experiment: what it reads from a run, its metrics, and when the host is to blame."""

from __future__ import annotations

import pytest

from experiments.vcan.stolen_time import StolenTime, steal_ms


def test_steal_is_read_where_it_is_reported_and_the_probe_measures() -> None:
    assert steal_ms("cpu 1 2 3 4 5 6 7 250 0 0\n") == pytest.approx(2500.0)
    assert steal_ms("cpu 1 2 3 4\n") == 0.0
    with StolenTime() as stolen:
        pass
    assert stolen.lost_ms >= stolen.longest_ms >= 0.0
