"""The chosen grasp as it is shown: where the pin will be, by the same kinematics that the crane is controlled with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi

import pytest

from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import Grasp
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.log_list import LogObservation
from autonomy.process.mission_publisher import chosen_grasp
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import decode_grasp, decode_mission, encode_grasp
from machine.geometry.grapple import rotator_for_yaw
from machine.loading.profile_file import load_profile
from machine.profile import Profile

PROFILE = load_profile("palms_471")
LOG = LogObservation(3, (-1.0, 4.0, -0.3), (0.6, 0.8, 0.0), 3.0, 0.2)


@dataclass
class Crane:
    phase: Phase
    grasp: Grasp | None
    profile: Profile = PROFILE


def crane(phase: Phase = Phase.DESCEND) -> Crane:
    pose = Arm(PROFILE).pose_above(-1.0, 4.0, 0.5, 1.2)
    turned = pose._replace(rot_rad=rotator_for_yaw(PROFILE, pose.slew_rad, 2.2))
    return Crane(phase, Grasp(LOG, turned, -0.4, 0.0, (replace(LOG, id=8),), reason="two logs"))


def test_the_grasp_is_shown_where_the_pin_will_be() -> None:
    shown = chosen_grasp(crane())
    assert shown is not None
    assert shown.pin_m == pytest.approx((-1.0, 4.0, 0.5), abs=1e-3)
    assert (shown.yaw_rad - 2.2 + pi / 2) % pi - pi / 2 == pytest.approx(0.0, abs=1e-3)
    assert (shown.logs, shown.reason) == ((3, 8), "two logs")


@pytest.mark.parametrize("phase", [Phase.LOOK, Phase.LIFT, Phase.CARRY, Phase.DONE, Phase.FAILED])
def test_it_is_shown_only_until_the_jaws_have_closed(phase: Phase) -> None:
    assert chosen_grasp(crane(phase)) is None
    assert chosen_grasp(None) is None


def test_the_datagram_is_whole_or_refused() -> None:
    shown = chosen_grasp(crane())
    assert shown is not None
    data = encode_grasp(shown, 1, 2, 3, b"key")
    assert decode_grasp(data, b"key") == (2, 3, shown)
    for damaged in (data[:-1], data[:40] + b"x" + data[41:], encode_grasp(shown, 1, 2, 3)):
        with pytest.raises(DatagramRefused):
            decode_grasp(damaged, b"key")
    with pytest.raises(DatagramRefused):
        decode_mission(data, b"key")
