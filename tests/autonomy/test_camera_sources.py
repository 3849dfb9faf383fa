"""Sources of frames: frame folders, a ZED with a fake SDK, and a stream with valid and invalid servers."""

import json
import socket
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.sources.frame_folder import INDEX, FrameFolder, FrameFolderWriter
from autonomy.perception.sources.stream import StreamCamera
from autonomy.perception.sources.zed import ZedCamera
from machine.geometry.optics import Intrinsics
from runtime.errors import LinkError
from tests.codes import coded

PIN = Intrinsics(8, 6, 10.0, 10.0, 3.5, 2.5)


def picture(stamp_ns: int) -> RgbdFrame:
    rng = np.random.default_rng(stamp_ns)
    depth_m = rng.uniform(0.5, 20.0, (6, 8)).astype(np.float32)
    depth_m[0, :3] = np.nan
    return RgbdFrame("front", stamp_ns, rng.integers(0, 256, (6, 8, 3), np.uint8), depth_m, PIN)


@pytest.mark.parametrize(("depth", "error_m"), [("png", 5.1e-4), ("npy", 0.0)])
def test_a_frame_folder_returns_the_frames_that_were_written(tmp_path: Path, depth: str, error_m: float) -> None:
    writer = FrameFolderWriter(tmp_path / "run", depth)
    for stamp in (5, 9):
        writer.add(picture(stamp))
    writer.close()
    folder = FrameFolder(tmp_path / "run")
    for stamp in (5, 9):
        frame, was = folder.frame(), picture(stamp)
        assert frame is not None and (frame.stamp_ns, frame.camera, frame.intrinsics) == (stamp, "front", PIN)
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

    class Camera:
        closed = False

        def open(self, settings):
            assert settings.coordinate_units == "METER" and settings.camera_fps == 15
            return state

        def get_camera_information(self):
            return SimpleNamespace(camera_configuration=configuration)

        def grab(self):
            return grabbed

        def is_opened(self):
            return opened

        def retrieve_image(self, mat, view):
            mat.data = {"LEFT": bgra}[view]

        def retrieve_measure(self, mat, what):
            mat.data = {"DEPTH": depth}[what]

        def get_timestamp(self, reference):
            return SimpleNamespace(get_nanoseconds=lambda: {"IMAGE": 77}[reference])

        def close(self):
            Camera.closed = True

    return SimpleNamespace(
        InitParameters=SimpleNamespace,
        Camera=Camera,
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
    assert sdk.Camera.closed


def test_a_zed_that_cannot_be_opened_is_late_or_disconnected() -> None:
    with pytest.raises(LinkError, check=coded("camera-source.not-opened")):
        ZedCamera("front", sdk=fake_sdk(state="CAMERA NOT DETECTED"))
    with pytest.raises(LinkError, check=coded("camera-source.no-resolution")):
        ZedCamera("front", "HD9", sdk=fake_sdk())
    assert ZedCamera("front", sdk=fake_sdk(grabbed="TIMEOUT")).frame() is None
    with pytest.raises(LinkError, check=coded("camera-source.disconnected")):
        ZedCamera("front", sdk=fake_sdk(grabbed="UNPLUGGED", opened=False)).frame()


def test_a_zed_that_was_pulled_is_opened_again_when_it_is_back() -> None:
    sdk = fake_sdk(grabbed="UNPLUGGED", opened=False)
    camera = ZedCamera("front", sdk=sdk)
    with pytest.raises(LinkError, check=coded("camera-source.disconnected")):
        camera.frame()
    sdk.Camera.open = lambda _self, _settings: "CAMERA NOT DETECTED"
    with pytest.raises(LinkError, check=coded("camera-source.not-opened")):
        camera.frame()
    sdk.Camera.open, sdk.Camera.grab = (lambda _self, _settings: "SUCCESS"), (lambda _self: "SUCCESS")
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
