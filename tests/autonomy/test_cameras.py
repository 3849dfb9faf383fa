"""Cameras: frames that are valid, the pose of a camera, and sources of frames."""

import json
import socket
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from autonomy.perception.camera.frame import Pose, RgbdFrame, check_frame, optical_pose, rescaled
from autonomy.perception.camera.survey import surveyed
from autonomy.perception.log_list import across
from autonomy.perception.sources.frame_folder import INDEX, FrameFolder, FrameFolderWriter
from autonomy.perception.sources.stream import StreamCamera
from autonomy.perception.sources.zed import ZedCamera
from machine.geometry.optics import BODY_FROM_OPTICAL, Intrinsics, intrinsics, rpy_matrix
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused, LinkError
from sim.camera.geometry import mount_view, quaternion_matrix
from sim.world import open_world
from tests.codes import coded

PIN = Intrinsics(64, 48, 40.0, 40.0, 31.5, 23.5)
GOOD = RgbdFrame("front", 1, np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 3.0, np.float32), PIN)


def test_a_good_frame_passes_and_its_depth_can_be_rescaled() -> None:
    check_frame(GOOD)
    assert rescaled(GOOD, 1.5).depth_m[0, 0] == pytest.approx(2.0)
    assert rescaled(GOOD, 1.5).depth_m.dtype == np.float32


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"depth_m": np.zeros((0, 0), np.float32), "rgb": np.zeros((0, 0, 3), np.uint8)}, "no-depth-array"),
        ({"depth_m": np.full((48, 64), np.nan, np.float32)}, "depth-unknown"),
        ({"depth_m": np.zeros((48, 64), np.float32)}, "depth-not-positive"),
        ({"depth_m": np.full((48, 64), 3000, np.uint16)}, "bad-depth-type"),
        ({"rgb": np.zeros((24, 32, 3), np.uint8)}, "bad-colour"),
        ({"rgb": np.zeros((48, 64, 3), np.float32)}, "bad-colour"),
        ({"intrinsics": replace(PIN, width_px=1280)}, "bad-size"),
        ({"intrinsics": replace(PIN, fx_px=0.0)}, "bad-intrinsics"),
        ({"intrinsics": replace(PIN, fy_px=float("nan"))}, "bad-intrinsics"),
        ({"intrinsics": replace(PIN, fx_px=4000.0, fy_px=4000.0)}, "bad-intrinsics"),
        ({"intrinsics": replace(PIN, cx_px=640.0)}, "bad-intrinsics"),
    ],
)
def test_an_invalid_frame_is_refused(change: dict, code: str) -> None:
    with pytest.raises(InputRefused, check=coded(f"frame.{code}")):
        check_frame(replace(GOOD, **change))


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_directions_across_are_orthogonal_to_the_axis(x: float, y: float, z: float) -> None:
    axis = np.array([x, y, z + 1e-3])
    if np.linalg.norm(axis) < 1e-2:
        return
    axis /= np.linalg.norm(axis)
    frame = np.stack([axis, *across(axis)])
    assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-9) and np.linalg.det(frame) == pytest.approx(1.0)


# -- the pose of a camera
@pytest.mark.parametrize(
    ("machine", "camera", "home"),
    [
        ("palms_471", "stick", {"slew": 0.7, "lift": 0.5, "tilt": -1.2, "ext": 0.2}),
        ("palms_471", "d435", {}),
        ("aoro_fc8", "front", {}),
    ],
)
def test_the_kinematic_chain_agrees_with_the_plant(machine: str, camera: str, home: dict[str, float]) -> None:
    profile = load_profile(machine)
    spec = profile.cameras[camera]
    with closing(open_world(profile, truth="nominal", seed=1, scene=(), home=home or None)) as world:
        # The column bends under the crane's weight, which no encoder measures: keep it rigid here.
        if home:
            world._place(home | {"flex_pitch": 0.0, "flex_roll": 0.0})
            world._read()
        q = [world.q[name] for name in ("slew", "lift", "tilt", "ext")]
        bend = world.carrier.articulation_rad if world.carrier else 0.0
        true = mount_view(world.link_poses()[spec.link], intrinsics(spec), spec.position_m, spec.rpy_rad)
        at, turn = world.base_pose()
    base = quaternion_matrix(turn)
    pose = optical_pose(profile, spec, q, bend)
    assert np.abs(base.T @ (true.position_m - at) - pose.position_m).max() < 1e-6
    assert np.abs(base.T @ true.rotation - pose.rotation).max() < 1e-6


def test_articulation_turns_the_front_camera() -> None:
    profile = load_profile("aoro_fc8")
    q = [0.0, 1.0, -2.0, 0.0]
    straight, bent = (optical_pose(profile, profile.cameras["front"], q, a) for a in (0.0, 0.4))
    turned = straight.rotation.T @ bent.rotation
    assert np.arccos((np.trace(turned) - 1.0) / 2.0) == pytest.approx(0.4)


def test_a_camera_on_a_swinging_link_is_refused() -> None:
    profile = load_profile("palms_471")
    with pytest.raises(InputRefused, check=coded("camera-mount.unknown-link")):
        optical_pose(profile, msgspec.structs.replace(profile.cameras["stick"], link="rotator"), [0.0, 0.5, -1.0, 0.0])


def targets(seed: int, wrong_m: float = 0.0):
    """What a camera that is 3 cm and 1.5 degrees off its profile, with 0.7 % too much depth, sees of a survey."""
    rng = np.random.default_rng(seed)
    camera = load_profile("aoro_fc8").cameras["front"]
    pin = intrinsics(camera)
    body = rpy_matrix(camera.rpy_rad)
    at = np.array(camera.position_m) + body @ (0.02, -0.02, 0.01)
    optical = body @ rpy_matrix((0.01, -0.02, 0.015)) @ BODY_FROM_OPTICAL
    z = rng.uniform(3.0, 8.0, 14)
    pixels = np.stack([rng.uniform(60, 1220, 14), rng.uniform(60, 660, 14)], axis=1)
    local = np.stack([pin.deproject(u, v, d) for (u, v), d in zip(pixels, z, strict=True)])
    places = local @ optical.T + at + rng.normal(0.0, 0.002 + wrong_m, (14, 3))
    return camera, pixels + rng.normal(0.0, 0.3, (14, 2)), 1.007 * z, places, at, optical


def test_a_survey_estimates_mount_and_scale() -> None:
    link = Pose(np.zeros(3), np.eye(3))
    camera, pixels, depths, places, at, optical = targets(1)
    depths[3] = np.nan
    found = surveyed(camera, link, pixels, depths, places)
    assert np.linalg.norm(np.array(found.position_m) - at) < 0.008
    assert np.abs(rpy_matrix(found.rpy_rad) @ BODY_FROM_OPTICAL - optical).max() < 0.002
    assert found.depth_scale == pytest.approx(1.007, abs=0.001)


def test_an_impossible_survey_is_refused() -> None:
    link = Pose(np.zeros(3), np.eye(3))
    camera, pixels, depths, places, _, _ = targets(2)
    with pytest.raises(InputRefused, check=coded("camera-mount.too-few-targets")):
        surveyed(camera, link, pixels[:5], depths[:5], places[:5])
    with pytest.raises(InputRefused, check=coded("camera-mount.bad-targets")):
        surveyed(camera, link, pixels[::-1], depths, places)
    with pytest.raises(InputRefused, check=coded("camera-mount.bad-depth-scale")):
        surveyed(camera, link, pixels, 1.3 * depths, places)


# -- sources of frames
SMALL = Intrinsics(8, 6, 10.0, 10.0, 3.5, 2.5)


def picture(stamp_ns: int) -> RgbdFrame:
    rng = np.random.default_rng(stamp_ns)
    depth_m = rng.uniform(0.5, 20.0, (6, 8)).astype(np.float32)
    depth_m[0, :3] = np.nan
    return RgbdFrame("front", stamp_ns, rng.integers(0, 256, (6, 8, 3), np.uint8), depth_m, SMALL)


@pytest.mark.parametrize(("depth", "error_m"), [("png", 5.1e-4), ("npy", 0.0)])
def test_a_frame_folder_returns_the_frames_that_were_written(tmp_path: Path, depth: str, error_m: float) -> None:
    writer = FrameFolderWriter(tmp_path / "run", depth)
    for stamp in (5, 9):
        writer.add(picture(stamp))
    writer.close()
    folder = FrameFolder(tmp_path / "run")
    for stamp in (5, 9):
        frame, was = folder.frame(), picture(stamp)
        assert frame is not None and (frame.stamp_ns, frame.camera, frame.intrinsics) == (stamp, "front", SMALL)
        assert np.array_equal(frame.rgb, was.rgb) and frame.depth_m.dtype == np.float32
        assert np.array_equal(np.isnan(frame.depth_m), np.isnan(was.depth_m))
        assert np.nanmax(np.abs(frame.depth_m - was.depth_m)) <= error_m
    assert folder.frame() is None


def test_a_folder_without_valid_index_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LinkError, check=coded("camera-source.no-frame-folder")):
        FrameFolder(tmp_path)
    (tmp_path / INDEX).write_text("{}")
    with pytest.raises(LinkError, check=coded("camera-source.bad-index")):
        FrameFolder(tmp_path)


def test_missing_or_wrong_pictures_are_refused(tmp_path: Path) -> None:
    writer = FrameFolderWriter(tmp_path)
    writer.add(picture(5))
    writer.close()
    with pytest.raises(LinkError, check=coded("camera-source.folder-in-use")):
        FrameFolderWriter(tmp_path)
    index = json.loads((tmp_path / INDEX).read_text())
    (tmp_path / INDEX).write_text(json.dumps({**index, "width_px": 80}))
    with pytest.raises(LinkError, check=coded("camera-source.bad-frame-size")):
        FrameFolder(tmp_path).frame()
    (tmp_path / INDEX).write_text(json.dumps(index))
    Image.fromarray(np.zeros((3, 3, 3), np.uint8)).save(tmp_path / "000000.png")
    with pytest.raises(LinkError, check=coded("camera-source.bad-frame-size")):
        FrameFolder(tmp_path).frame()
    (tmp_path / "000000.depth.png").write_bytes(b"no picture")
    with pytest.raises(LinkError, check=coded("camera-source.bad-frame")):
        FrameFolder(tmp_path).frame()


def fake_sdk(state: str = "SUCCESS", grabbed: str = "SUCCESS", opened: bool = True) -> SimpleNamespace:
    """The part of ``pyzed.sl`` that is used."""
    depth = np.array([[1.0, np.inf, -np.inf], [np.nan, 2.5, 0.0]], np.float32)
    bgra = np.dstack([np.full((2, 3), v, np.uint8) for v in (1, 2, 3, 255)])
    left = SimpleNamespace(fx=5.0, fy=5.5, cx=1.0, cy=0.5)
    configuration = SimpleNamespace(
        calibration_parameters=SimpleNamespace(left_cam=left), resolution=SimpleNamespace(width=3, height=2)
    )

    class Mat:
        data = None

        def get_data(self):
            return self.data

    def opening(settings):
        assert settings.coordinate_units == "METER" and settings.camera_fps == 15
        return state

    camera = SimpleNamespace(
        closed=False,
        open=opening,
        get_camera_information=lambda: SimpleNamespace(camera_configuration=configuration),
        grab=lambda: grabbed,
        is_opened=lambda: opened,
        retrieve_image=lambda mat, view: setattr(mat, "data", {"LEFT": bgra}[view]),
        retrieve_measure=lambda mat, what: setattr(mat, "data", {"DEPTH": depth}[what]),
        get_timestamp=lambda reference: SimpleNamespace(get_nanoseconds=lambda: {"IMAGE": 77}[reference]),
        close=lambda: setattr(camera, "closed", True),
    )
    return SimpleNamespace(
        InitParameters=SimpleNamespace,
        camera=camera,
        Camera=lambda: camera,
        Mat=Mat,
        RESOLUTION=SimpleNamespace(HD720="HD720"),
        UNIT=SimpleNamespace(METER="METER"),
        DEPTH_MODE=SimpleNamespace(ULTRA="ULTRA"),
        ERROR_CODE=SimpleNamespace(SUCCESS="SUCCESS"),
        VIEW=SimpleNamespace(LEFT="LEFT"),
        MEASURE=SimpleNamespace(DEPTH="DEPTH"),
        TIME_REFERENCE=SimpleNamespace(IMAGE="IMAGE"),
    )


def test_a_zed_delivers_its_intrinsics_rgb_and_nan_for_unknown_depth() -> None:
    sdk = fake_sdk()
    camera = ZedCamera("front", sdk=sdk)
    frame = camera.frame()
    assert frame is not None and frame.intrinsics == Intrinsics(3, 2, 5.0, 5.5, 1.0, 0.5)
    assert frame.stamp_ns == 77 and frame.rgb[0, 0].tolist() == [3, 2, 1]
    assert np.array_equal(frame.depth_m, np.array([[1.0, np.nan, np.nan], [np.nan, 2.5, np.nan]]), equal_nan=True)
    camera.close()
    assert sdk.camera.closed


def test_a_zed_that_cannot_be_opened_is_refused_and_a_late_one_gives_no_frame() -> None:
    with pytest.raises(LinkError, check=coded("camera-source.not-opened")):
        ZedCamera("front", sdk=fake_sdk(state="CAMERA NOT DETECTED"))
    with pytest.raises(LinkError, check=coded("camera-source.no-resolution")):
        ZedCamera("front", "HD9", sdk=fake_sdk())
    assert ZedCamera("front", sdk=fake_sdk(grabbed="TIMEOUT")).frame() is None


def test_a_zed_that_was_pulled_is_opened_again_when_it_is_back() -> None:
    sdk = fake_sdk(grabbed="UNPLUGGED", opened=False)
    camera = ZedCamera("front", sdk=sdk)
    with pytest.raises(LinkError, check=coded("camera-source.disconnected")):
        camera.frame()
    sdk.camera.open = lambda settings: "CAMERA NOT DETECTED"
    with pytest.raises(LinkError, check=coded("camera-source.not-opened")):
        camera.frame()
    sdk.camera.open, sdk.camera.grab = (lambda settings: "SUCCESS"), (lambda: "SUCCESS")
    frame = camera.frame()
    assert frame is not None and frame.stamp_ns == 77


def test_a_zed_without_its_sdk_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyzed", None)
    with pytest.raises(LinkError, check=coded("camera-source.no-sdk")) as told:
        ZedCamera("front")
    assert "\n" not in str(told.value)


def test_a_missing_server_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    camera = StreamCamera(address, "front", timeout_s=0.5)
    assert camera.frame() is None and address in camera.problem
    assert StreamCamera("nonsense", "front").frame() is None
    missing = StreamCamera("unix:/nowhere/socket", "front")
    assert missing.frame() is None and "/nowhere/socket" in missing.problem
