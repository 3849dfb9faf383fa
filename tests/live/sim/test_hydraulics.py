"""Hydraulics against closed forms: pressures, stiffness, speeds, shared flow, holding, valves, energy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.sim.oil_rig import random_run_hash


def test_two_processes_give_the_same_bits():
    code = "from tests.sim.oil_rig import random_run_hash; print(random_run_hash())"
    other = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[3], capture_output=True, text=True)
    assert other.stdout.strip() == random_run_hash(), other.stderr
