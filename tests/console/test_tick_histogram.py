"""The histograms of the page: every duration is in the bar of its size."""

from __future__ import annotations

import json

from can_dbc.timing.durations import Durations
from can_dbc.timing.page import STAGES, Timing
from console.state import EDGES_US, SHOWN, histograms


def test_every_duration_is_in_the_bar_of_its_size(timing) -> None:
    found = {name: Durations() for name in STAGES}
    sizes_us = (0, 1, 3, 49, 51, 999, 1500, 60_000, 150_000)
    for us in sizes_us:
        found["wake"].add(us * 1000)
    seen = histograms(Timing(timing(9).facts, found))
    json.dumps(seen, allow_nan=False)
    wake = next(h for h in seen["of"] if h["name"] == "wake")
    expected = [0] * (len(EDGES_US) + 1)
    for us in sizes_us:  # a bin of 1 us begins at its lower edge
        expected[next((i for i, edge in enumerate(EDGES_US) if us < edge), len(EDGES_US))] += 1
    assert wake["counts"] == expected and sum(wake["counts"]) == len(sizes_us)
    assert [h["name"] for h in seen["of"]] == list(SHOWN) and wake["max_us"] == 150_000
