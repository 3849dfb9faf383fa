"""The analytic renderer against closed forms, against pybullet's renderer, and against itself."""

import hashlib
import subprocess
import sys
from pathlib import Path

from sim.camera.render import ImagingConditions, render
from tests.sim.camera_scenes import ABOVE, site

DIGEST = """
import hashlib
from tests.sim.camera_scenes import ABOVE, site
from sim.camera.render import ImagingConditions, render
p = render(site(10), ABOVE, ImagingConditions.random(3), 7)
print(hashlib.sha256(p.rgb.tobytes() + p.depth_m.tobytes() + p.mask.tobytes()).hexdigest())
"""


def test_two_processes_render_the_same_bytes() -> None:
    root = Path(__file__).parents[3]
    run = subprocess.run([sys.executable, "-c", DIGEST], cwd=root, capture_output=True, text=True, check=True)
    p = render(site(10), ABOVE, ImagingConditions.random(3), 7)
    assert run.stdout.strip() == hashlib.sha256(p.rgb.tobytes() + p.depth_m.tobytes() + p.mask.tobytes()).hexdigest()
