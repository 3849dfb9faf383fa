"""The mask network's training by its commands: tiny sets, one or two steps on the CPU."""

import sys

import pytest

from runtime.errors import InputRefused
from tests.codes import coded
from training.pictures import piles
from training.pictures.samples import read
from training.pictures.traced import sets

STAND_IN = """#!{python}
import json, sys
from pathlib import Path
import numpy as np
work = Path(sys.argv[3])
(work / "pictures").mkdir()
for file in (work / "scenes").glob("*.json"):
    for k, view in enumerate(json.loads(file.read_text())["views"]):
        shape = view["height_px"], view["width_px"]
        np.savez(work / "pictures" / f"{{file.stem}}-{{k}}.npz", light=np.ones((*shape, 3), np.float16),
                 depth_m=np.full(shape, 2.0, np.float32), ids=np.zeros(shape, np.uint8))
"""


def test_what_blender_drew_becomes_samples(tmp_path):
    """Blender's worker writes light, depth and numbers; a stand-in does so here."""
    worker = tmp_path / "python"
    worker.write_text(STAND_IN.format(python=sys.executable))
    worker.chmod(0o755)
    plan = sets.SetPlan(scenes=1, size_px=48)
    out = tmp_path / "pictures"
    out.mkdir()
    settled = [piles.settle("palms_471", 5)]
    form = sets.Format(48, 1, 2, 0.0)
    for _ in range(2):  # the second time nothing is missing
        sets.blender_files(out, plan, settled, form, 1, worker, lambda _: None)
    back = read(out / "traced00000.npz")
    assert back["rgb"].shape == (2, 48, 48, 3) and (back["depth_mm"] == 2000).all()
    worker.write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(InputRefused, check=coded("dataset.blender-failed")):
        sets.blender_files(tmp_path, plan, settled, form, 1, worker, lambda _: None)
