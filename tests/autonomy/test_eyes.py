"""The eyes look while the crane rests, and say why when they see nothing."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.log_detector import FAMILIAR_NS, LogDetector
from autonomy.perception.sources.camera_source import SourceError
from machine.loading.profile_file import load_profile
from machine.geometry.optics import intrinsics

PROFILE = load_profile("palms_471")
CAMERA = "stick"
Q = (0.0, 0.6, -1.2, 0.3, 0.0)
STEP_NS = 250_000_000


@dataclass
class Source:
    """Gives pictures of an empty, level world, or trouble."""

    trouble: str = ""
    problem: str = ""
    count: int = field(default=0)

    def frame(self) -> RgbdFrame | None:
        if self.trouble:
            raise SourceError(self.trouble)
        if self.problem:
            return None
        self.count += 1
        pin = intrinsics(PROFILE.cameras[CAMERA])
        shape = (pin.height_px, pin.width_px)
        return RgbdFrame(CAMERA, self.count, np.full((*shape, 3), 90, np.uint8), np.full(shape, 4.0, np.float32), pin)

    def close(self) -> None: ...


def eyes(source: Source) -> LogDetector:
    return LogDetector(PROFILE, CAMERA, source, lambda frame: ())


def test_the_first_question_only_shows_where_the_crane_is_and_the_second_gets_a_look() -> None:
    source = Source()
    one = eyes(source)
    assert one.detect(Q, STEP_NS) is None and source.count == 0
    assert one.detect(Q, 2 * STEP_NS) == () and source.count == 1
    assert not one.trouble


def test_nothing_is_looked_at_while_the_crane_moves_or_after_a_long_silence() -> None:
    source = Source()
    one = eyes(source)
    one.detect(Q, STEP_NS)
    moved = (Q[0] + 0.02, *Q[1:])
    assert one.detect(moved, 2 * STEP_NS) is None
    assert one.detect(moved, 2 * STEP_NS + FAMILIAR_NS) is None
    assert one.detect(moved, 3 * STEP_NS + FAMILIAR_NS) == ()
    assert source.count == 1


def test_a_joint_that_nobody_measures_does_not_keep_it_from_looking_unless_the_camera_hangs_on_it() -> None:
    blind = eyes(Source())
    for k in (1, 2):
        seen = blind.detect((*Q[:4], math.nan), k * STEP_NS)
    assert seen == ()
    for k in (3, 4):
        seen = blind.detect((Q[0], math.nan, *Q[2:]), k * STEP_NS)
    assert seen is None and "unknown" in blind.trouble


@pytest.mark.parametrize("source", [Source(trouble="unplugged"), Source(problem="unplugged")])
def test_a_camera_that_gives_nothing_is_told_and_makes_up_no_log(source: Source) -> None:
    one = eyes(source)
    one.detect(Q, STEP_NS)
    assert one.detect(Q, 2 * STEP_NS) is None
    assert one.trouble == "unplugged"


def test_the_process_refuses_a_camera_that_the_machine_does_not_have() -> None:
    done = run("--camera", "moon", "--frames", "127.0.0.1:1")
    assert done.returncode == 3
    assert "no camera 'moon'; it has: stick" in done.stderr


def test_the_process_refuses_weights_that_are_none(tmp_path: Path) -> None:
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"nothing")
    done = run("--camera", CAMERA, "--frames", "127.0.0.1:1", "--weights", bad)
    assert done.returncode == 3
    assert str(bad) in done.stderr and "Traceback" not in done.stderr


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "autonomy.perception", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
