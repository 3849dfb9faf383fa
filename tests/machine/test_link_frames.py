"""The frames for display chain to the same points as the kinematics that the crane is controlled with."""

from __future__ import annotations

from math import nan

import numpy as np
import pytest

from machine.geometry.kinematics import chain_points
from machine.geometry.link_frames import BASE, LinkFrame, link_frames
from machine.loading.profile_file import load_profile


def turned(rotation: tuple[float, float, float, float]) -> np.ndarray:
    x, y, z, w = rotation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def placed(frames: tuple[LinkFrame, ...]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Origin and rotation of every frame in the base frame."""
    found = {BASE: (np.zeros(3), np.eye(3))}
    for frame in frames:
        origin, rotation = found[frame.parent]
        found[frame.child] = (origin + rotation @ frame.translation_m, rotation @ turned(frame.rotation))
    return found


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
@pytest.mark.parametrize("q", [(0.0, 0.3, -1.0, 0.1, 0.0), (-1.1, 0.9, -1.7, 0.8, 1.2)])
def test_the_frames_chain_to_the_points_of_the_kinematics(name: str, q: tuple[float, ...]) -> None:
    profile = load_profile(name)
    points, frames = chain_points(profile.kinematics, q), placed(link_frames(profile, q))
    for frame, point in (
        ("boom", points.boom_pin),
        ("stick", points.stick_pin),
        ("pin", points.hanger_pin),
        ("grapple", points.grapple),
    ):
        assert frames[frame][0] == pytest.approx(np.array(point), abs=1e-9), frame
    boom = np.array(points.stick_pin) - points.boom_pin
    assert frames["boom"][1][:, 0] == pytest.approx(boom / np.linalg.norm(boom), abs=1e-9), "x is along the boom"
    telescope = np.array(points.hanger_pin) - points.telescope_front
    assert frames["stick"][1][:, 0] == pytest.approx(telescope / np.linalg.norm(telescope), abs=1e-9)
    assert frames["grapple"][1][:, 2] == pytest.approx(np.array([0.0, 0.0, 1.0]), abs=1e-9), "it hangs"


def test_what_depends_on_an_unknown_joint_is_left_out() -> None:
    profile = load_profile("palms_471")
    assert [f.child for f in link_frames(profile, (0.0, 0.3, -1.0, 0.1, nan))] == ["column", "boom", "stick", "pin"]
    assert link_frames(profile, (0.0, nan, -1.0, 0.1, 0.0)) == ()
