"""The ground truth: complete files, bounded individuals, the same individual for the same seed."""

from __future__ import annotations

import subprocess
import sys

from sim.truth.load import load_truth


def test_another_process_draws_the_same_individual():
    code = "from sim.truth.load import FILES, load_truth; print(load_truth('sampled', 7, 'aoro_fc8'))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert other.stdout.strip() == str(load_truth("sampled", 7, "aoro_fc8")), other.stderr
