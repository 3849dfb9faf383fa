"""The rates experiment without a clock: lines, what a processor carries, what is open; and one replay in real time."""

from __future__ import annotations

from experiments.timing import rates
from hil.tick.compare import kept_recordings


def test_replayed_controllers_share_a_processor_and_give_the_recorded_bytes(tmp_path):
    recording = kept_recordings(tmp_path)[-1]
    found = rates.run_cranes(recording, 2, 200, tmp_path)
    assert (found.cranes, found.ticks, found.differing) == (2, 400, 0) and found.cpu_us > 0.0
