"""Demonstrations out of a bus, the primitives that are learned from them, and the motions between bunk and log."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autonomy.motion import movement_primitives
from autonomy.motion.arm_kinematics import Arm, Pose
from autonomy.motion.demonstration import (
    AXES,
    GRID_S,
    JointTrack,
    format_demonstrations,
    joint_track,
    read_demonstrations,
    segment_motions,
    smoothed,
)
from autonomy.motion.movement_primitives import Dmp, PrimitiveMotions, algorithm_1, learn, learn_primitives
from can_dbc.dbc.codec import load as load_database
from can_dbc.frame import Frame
from can_dbc.messages.crane import GrappleCommand
from machine.geometry.kinematics import Unreachable
from machine.joints import Joint
from machine.loading.profile_file import load_profile
from machine.profile import joint
from machine.sensing import counts_from_position
from runtime.errors import InputRefused
from tests.codes import coded

PROFILE = load_profile("aoro_fc8")
ARM = Arm(PROFILE)
CRANE = load_database("crane")
SHIPPED = movement_primitives.SHIPPED_FOLDER / "aoro_fc8.csv"
REST = np.array([0.0, 1.2, -2.3, 0.1])
OVER_BUNK = ARM.compact_pose_above(*PROFILE.bunk.center_m, 1.95, 3.0)

FILE_CODES = {"demonstration.unreadable", "demonstration.wrong-format", "demonstration.malformed-line"}


def rise(time_s: np.ndarray, begin_s: float, end_s: float) -> np.ndarray:
    tau = np.clip((time_s - begin_s) / (end_s - begin_s), 0.0, 1.0)
    return tau**3 * (10.0 - 15.0 * tau + 6.0 * tau**2)


def shown() -> JointTrack:
    """Out for 4 s, a rest with a small correction, back for 4 s, rest."""
    time_s = np.arange(0.0, 16.0, GRID_S)
    way = rise(time_s, 1.0, 5.0) - rise(time_s, 10.0, 14.0)
    little = 0.01 * (rise(time_s, 6.5, 7.0) - rise(time_s, 8.0, 8.5))
    return JointTrack(
        time_s, REST + way[:, None] * np.array([0.8, -0.9, 1.0, 0.3]) + little[:, None] * np.array([1, 0, 0, 0])
    )


def frames(positions: JointTrack, without: Joint | None = None) -> list[Frame]:
    """What the encoders would have sent, 100 times a second each, among frames of others."""
    out = []
    for t in np.arange(0.0, positions.time_s[-1], 0.01):
        q = [np.interp(t, positions.time_s, column) for column in positions.position.T]
        stamp = 7_000_000_000 + round(t * 1e9)
        for j, value in zip(AXES, q, strict=True):
            encoder = joint(PROFILE, j).encoder
            codec = CRANE.messages[encoder.message]
            counts = counts_from_position(encoder, value)
            values = {s.name: 0 for s in codec.signals} | {"Position": counts}
            if j is not without:
                out.append(Frame(stamp, codec.key, codec.encode(*(values[s.name] for s in codec.signals))))
        out.append(Frame(stamp, 0x80, b""))
    return out


def test_encoder_frames_become_joint_positions_over_time() -> None:
    found = joint_track(PROFILE, CRANE, frames(shown()))
    assert found.time_s[0] == 0.0 and np.diff(found.time_s) == pytest.approx(GRID_S)
    expected = np.column_stack([np.interp(found.time_s, shown().time_s, c) for c in shown().position.T])
    assert np.max(np.abs(found.position - expected)) < 1e-3


def test_a_log_without_an_encoder_or_without_time_stamps_is_refused() -> None:
    one_missing = frames(shown(), without=Joint.TILT)
    with pytest.raises(InputRefused, check=coded("demonstration.encoder-missing")):
        joint_track(PROFILE, CRANE, one_missing)
    with pytest.raises(InputRefused, check=coded("demonstration.no-stamps")):
        joint_track(PROFILE, CRANE, [Frame(0, frame.key, frame.data) for frame in one_missing])


def test_motions_are_segmented_from_rest_to_rest_without_small_corrections() -> None:
    out, back = segment_motions(PROFILE, shown())
    assert out.time_s[0] == back.time_s[0] == 0.0
    assert out.time_s[-1] == pytest.approx(4.0, abs=0.7)
    assert out.position[0] == pytest.approx(REST, abs=0.01) == back.position[-1]
    assert out.position[-1] == pytest.approx(back.position[0], abs=0.012)


def test_a_motion_that_does_not_move_the_pin_is_left_out() -> None:
    time_s = np.arange(0.0, 10.0, GRID_S)
    turned = REST + (0.2 * rise(time_s, 3.0, 6.0))[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
    assert segment_motions(PROFILE, JointTrack(time_s, turned)) == ()
    assert segment_motions(PROFILE, JointTrack(time_s, np.tile(REST, (len(time_s), 1)))) == (), "it stands still"
    enough = REST + (0.9 * rise(time_s, 3.0, 6.0))[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
    assert len(segment_motions(PROFILE, JointTrack(time_s, enough))) == 1


def test_smoothing_takes_tremor_out_without_delay() -> None:
    time_s = np.arange(0.0, 6.0, GRID_S)
    clean = rise(time_s, 1.0, 5.0)[:, None]
    trembling = clean + 0.01 * np.sin(2.0 * np.pi * 5.0 * time_s + 0.3)[:, None]
    left = smoothed(trembling)
    assert np.max(np.abs(left - clean)[10:-10]) < 0.008
    quiet, loud = (np.abs(np.diff(y, axis=0))[10:-10].max() for y in (left - smoothed(clean), trembling - clean))
    assert quiet < 0.05 * loud
    lag = np.argmax(np.correlate(left[:, 0] - left.mean(), clean[:, 0] - clean.mean(), "full")) - len(time_s) + 1
    assert lag == 0


def test_a_file_of_demonstrations_reads_back(tmp_path: Path) -> None:
    motions = segment_motions(PROFILE, shown())
    (tmp_path / "shown.csv").write_text(format_demonstrations("aoro_fc8", motions))
    name, again = read_demonstrations(tmp_path / "shown.csv")
    assert name == "aoro_fc8" and len(again) == 2
    for a, b in zip(motions, again, strict=True):
        assert len(b.position) == pytest.approx(len(a.position), abs=1)
        n = min(len(a.position), len(b.position))
        assert np.max(np.abs(a.position[:n] - b.position[:n])) < 0.003


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# a comment\na,b\n",
        "# demonstrations of aoro_fc8; x\nmotion,time_s,slew_rad,lift_rad,tilt_rad,ext_m\n1,2,x\n",
    ],
)
def test_another_file_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "other.csv").write_text(text)
    with pytest.raises(InputRefused, check=lambda e: e.code in FILE_CODES and "other.csv" in str(e)):
        read_demonstrations(tmp_path / "other.csv")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputRefused, check=coded("demonstration.unreadable")):
        read_demonstrations(tmp_path / "missing.csv")


def test_the_shipped_primitives_are_what_the_shipped_demonstrations_teach() -> None:
    _, motions = read_demonstrations(SHIPPED)
    learned, shipped = learn_primitives(PROFILE, motions), movement_primitives.load(PROFILE)
    assert (learned.out.demonstrations, learned.back.demonstrations) == (6, 6)
    for a, b in ((learned.out, shipped.out), (learned.back, shipped.back)):
        assert np.array(a.weights) == pytest.approx(np.array(b.weights), rel=1e-3, abs=1e-3)
        assert a.duration_s == pytest.approx(b.duration_s, abs=1e-3)
    assert SHIPPED.stat().st_size < 200_000


@pytest.mark.parametrize("x", [3.2, 4.6])
@pytest.mark.parametrize("y", [-4.2, -2.6, 2.6, 4.2])
def test_what_was_learned_leads_over_the_stakes_to_any_log_and_back(x: float, y: float) -> None:
    move = PrimitiveMotions(movement_primitives.load(PROFILE))
    log = ARM.compact_pose_above(x, y, 0.1, 3.0)._replace(rot_rad=0.4)
    for start, goal in ((OVER_BUNK, log), (log, OVER_BUNK)):
        motion = move(ARM, start, goal)
        q = np.array(motion.position)
        assert ARM.pose(q[0]) == pytest.approx(start, abs=1e-6) and ARM.pose(q[-1]) == pytest.approx(goal, abs=1e-6)
        v = np.gradient(q, 0.02, axis=0)
        assert np.max(np.abs(v) / ARM.speed) < 1.01
        poses = np.array([ARM.pose(row) for row in q])
        across = poses[:, 1] * np.sin(poses[:, 0])
        beside = np.abs(np.abs(across) - 1.0) < 0.1
        assert poses[beside, 2].min() > 2.5  # tips of closed tongs 1.35 m lower, stakes up to 1.25 m
        assert np.all(np.sign(across[np.abs(across) > 0.05]) == np.sign(y))


def test_the_other_side_is_the_mirror_image() -> None:
    move = PrimitiveMotions(movement_primitives.load(PROFILE))
    log = ARM.compact_pose_above(4.0, 3.2, 0.1, 3.0)
    start = OVER_BUNK._replace(slew_rad=0.0)
    left, right = (np.array(move(ARM, start, log._replace(slew_rad=s * log.slew_rad)).position) for s in (1.0, -1.0))
    assert right[:, 0] == pytest.approx(-left[:, 0], abs=1e-9)
    assert right[:, 1:4] == pytest.approx(left[:, 1:4], abs=1e-9)


def test_algorithm_1_opens_on_the_way_closes_there_and_opens_over_the_bunk() -> None:
    log = ARM.compact_pose_above(4.0, 3.2, 0.1, 3.0)._replace(rot_rad=0.5)
    out, back = algorithm_1(ARM, movement_primitives.load(PROFILE), OVER_BUNK, log, OVER_BUNK)
    assert (out.meanwhile, out.then) == (GrappleCommand.OPEN, GrappleCommand.CLOSE)
    assert (back.meanwhile, back.then) == (GrappleCommand.HOLD, GrappleCommand.OPEN)
    assert ARM.pose(out.motion.goal) == pytest.approx(log, abs=1e-6)
    assert ARM.pose(back.motion.goal) == pytest.approx(OVER_BUNK, abs=1e-6)
    assert out.motion.at(out.motion.duration_s + 1.0)[1] == (0.0,) * 5


def test_a_log_out_of_reach_is_refused() -> None:
    far = Pose(0.7, 12.0, 0.1, 2.5, 0.0)
    with pytest.raises(Unreachable, check=coded("reach.too-far")):
        PrimitiveMotions(movement_primitives.load(PROFILE))(ARM, OVER_BUNK, far)


def test_one_direction_alone_teaches_the_other_in_reverse() -> None:
    _, motions = read_demonstrations(SHIPPED)
    out, _ = movement_primitives.split_by_direction(ARM, motions)
    learned = learn_primitives(PROFILE, out)
    assert (learned.out.demonstrations, learned.back.demonstrations) == (6, 0)
    ends = movement_primitives.pose_track(ARM, out[2])[[-1, 0]]
    back = learned.back.dmp().rollout(ends[0], ends[1])
    assert back.position[:, 2].max() > 2.8


def test_motions_beside_the_bunk_teach_nothing() -> None:
    beside = shown()
    beside = JointTrack(beside.time_s, beside.position + np.array([1.2, 0.0, 0.0, 0.0]))
    with pytest.raises(InputRefused, check=coded("demonstration.not-at-bunk")):
        learn_primitives(PROFILE, segment_motions(PROFILE, beside))


def test_a_file_of_primitives_is_accepted_whole_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "some.json"
    good = movement_primitives.load(PROFILE)
    file.write_bytes(movement_primitives.encode(good))
    assert movement_primitives.load(PROFILE, file) == good
    nan = msgspec.structs.replace(good.out, duration_s=-1.0)
    cases = {
        "primitives.malformed": b"{",
        "primitives.other-machine": movement_primitives.encode(msgspec.structs.replace(good, profile="palms_471")),
        "primitives.implausible": movement_primitives.encode(msgspec.structs.replace(good, out=nan)),
    }
    for code, data in cases.items():
        file.write_bytes(data)
        with pytest.raises(InputRefused, check=coded(code)):
            movement_primitives.load(PROFILE, file)
    with pytest.raises(InputRefused, check=coded("primitives.unreadable")):
        movement_primitives.load(load_profile("palms_471"))


# -- primitives
TIME_S = np.linspace(0.0, 6.0, 301)
TAU = TIME_S / 6.0
RISE = TAU**3 * (10.0 - 15.0 * TAU + 6.0 * TAU**2)
SHOWN = np.stack([0.2 + 0.9 * RISE, 0.3 + 0.4 * np.sin(np.pi * RISE) ** 2 - 0.1 * RISE], axis=1)
"""A slew, and a height that goes over something and ends a little lower than it began."""
SCALED = learn([(TIME_S, SHOWN)], (True, False))
PLAIN = learn([(TIME_S, SHOWN)])
# movement-primitives 0.9.1, DMP(2, 6.0, dt=0.02, n_weights_per_dim=40, smooth_scaling=True) on the same, every second
LIBRARY = {
    (1.1, 0.2): (
        [0.2, 0.2337, 0.3934, 0.6556, 0.9155, 1.0698, 1.1],
        [0.3, 0.3018, 0.4347, 0.6492, 0.3647, 0.2078, 0.2],
    ),
    (1.6, 0.4): (
        [0.2, 0.3247, 0.6569, 1.037, 1.359, 1.5433, 1.5877],
        [0.3, 0.3382, 0.5401, 0.8017, 0.5421, 0.3972, 0.3951],
    ),
    (-0.7, -0.1): (
        [0.2, -0.094, -0.5553, -0.7173, -0.6809, -0.6349, -0.6556],
        [0.3, 0.2472, 0.2766, 0.4204, 0.0986, -0.0763, -0.0926],
    ),
}
places = st.floats(-2.0, 2.0)


@pytest.mark.parametrize("dmp", [SCALED, PLAIN])
def test_it_reproduces_the_demonstration(dmp: Dmp) -> None:
    again = dmp.rollout(SHOWN[0], SHOWN[-1])
    assert again.duration_s == pytest.approx(6.0)
    assert np.max(np.abs(again.at(TIME_S) - SHOWN) / np.ptp(SHOWN, axis=0)) < 0.02


@settings(deadline=None, max_examples=20)
@given(places, places, places, places)
def test_it_reaches_any_goal_and_is_at_rest_there(a: float, b: float, c: float, d: float) -> None:
    for dmp in (SCALED, PLAIN):
        motion = dmp.rollout(np.array([a, b]), np.array([c, d]))
        assert motion.position[0] == pytest.approx([a, b])
        assert motion.position[-1] == pytest.approx([c, d], abs=1e-9)
        size = np.abs([c - a, d - b]) + np.ptp(SHOWN, axis=0)
        assert np.all(np.abs(motion.position - [a, b]).max(axis=0) < 1.5 * size)
        last = np.abs(np.diff(motion.position[-3:], axis=0))[-1] * 400
        assert np.all(last < 0.05 * size)


@pytest.mark.parametrize("end", [0.1, 0.299999, 0.3, 0.300001, 0.5])
def test_a_lift_that_ends_where_it_began_neither_diverges_nor_turns_into_a_dip(end: float) -> None:
    height = PLAIN.rollout(np.array([0.0, 0.3]), np.array([1.0, end])).position[:, 1]
    assert 0.55 < height.max() < 1.0
    assert height.min() > min(0.3, end) - 0.05


@pytest.mark.parametrize("goal", LIBRARY)
def test_it_agrees_with_the_library(goal: tuple[float, float]) -> None:
    """Within 3 % of the range: the library fits its weights all at once, and does not land at the goal."""
    ours = PLAIN.rollout(SHOWN[0], np.array(goal)).at(np.arange(7.0))
    size = np.abs(np.array(goal) - SHOWN[0]) + np.ptp(SHOWN, axis=0)
    assert np.max(np.abs(ours - np.array(LIBRARY[goal]).T) / size) < 0.03


def test_a_motion_is_the_same_at_any_sampling_and_duration() -> None:
    motion = SCALED.rollout(SHOWN[0], SHOWN[-1])
    coarse, fine = motion.at(np.arange(0.0, 6.0, 0.5)), motion.at(np.arange(0.0, 6.0, 0.005))
    assert coarse == pytest.approx(fine[::100])
    assert motion.at(np.array([8.0]), 16.0) == pytest.approx(motion.at(np.array([3.0])))
    assert motion.at(np.array([-1.0, 99.0])) == pytest.approx(SHOWN[[0, -1]], abs=1e-9)


def test_demonstrations_count_alike_and_the_duration_is_their_mean() -> None:
    long = np.linspace(0.0, 10.0, 1001)
    stretched = np.column_stack([np.interp(long * 0.6, TIME_S, column) for column in SHOWN.T])
    both = learn([(TIME_S, SHOWN), (long, stretched)], (True, False))
    assert both.duration_s == pytest.approx(8.0)
    position = both.rollout(SHOWN[0], SHOWN[-1]).position
    assert np.max(np.abs(position - SCALED.rollout(SHOWN[0], SHOWN[-1]).position)) < 0.01


def test_demonstrations_that_teach_nothing_are_refused() -> None:
    flat = SHOWN.copy()
    flat[:, 0] = 0.2
    cases = {
        "demonstration.none": [],
        "demonstration.too-few-samples": [(TIME_S[:5], SHOWN[:5])],
        "demonstration.not-finite": [(TIME_S, np.where(TAU[:, None] > 0.5, np.nan, SHOWN))],
        "demonstration.times-not-increasing": [(TIME_S[::-1], SHOWN)],
        "demonstration.coordinate-unmoved": [(TIME_S, flat)],
    }
    for code, shown in cases.items():
        with pytest.raises(InputRefused, check=coded(code)):
            learn(shown, (True, False))
    with pytest.raises(InputRefused, check=coded("primitive.not-finite")):
        SCALED.rollout(np.array([0.0, np.nan]), np.array([1.0, 1.0]))
