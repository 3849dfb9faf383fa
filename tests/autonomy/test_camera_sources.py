"""Where frames come from: recordings, a ZED behind a fake of its SDK, and a stream with servers good and bad."""

import json
import socket
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from autonomy.perception.camera.frame import RgbdFrame
from autonomy.perception.sources.camera_source import SourceError
from autonomy.perception.sources.frame_folder import INDEX, Recorder, Recording
from autonomy.perception.sources.stream import StreamCamera
from autonomy.perception.sources.zed import ZedCamera
from can_dbc.messages.rgbd import QUESTION, RgbdMessage, encode, encode_refusal, question_bytes
from machine.geometry.optics import Intrinsics

PIN = Intrinsics(8, 6, 10.0, 10.0, 3.5, 2.5)


def picture(stamp_ns: int) -> RgbdFrame:
    rng = np.random.default_rng(stamp_ns)
    depth_m = rng.uniform(0.5, 20.0, (6, 8)).astype(np.float32)
    depth_m[0, :3] = np.nan
    return RgbdFrame("front", stamp_ns, rng.integers(0, 256, (6, 8, 3), np.uint8), depth_m, PIN)


@pytest.mark.parametrize(("depth", "error_m"), [("png", 5.1e-4), ("npy", 0.0)])
def test_a_recording_gives_back_what_was_recorded(tmp_path: Path, depth: str, error_m: float) -> None:
    recorder = Recorder(tmp_path / "run", depth)
    for stamp in (5, 9):
        recorder.add(picture(stamp))
    recorder.close()
    recording = Recording(tmp_path / "run")
    for stamp in (5, 9):
        frame, was = recording.frame(), picture(stamp)
        assert frame is not None and (frame.stamp_ns, frame.camera, frame.intrinsics) == (stamp, "front", PIN)
        assert np.array_equal(frame.rgb, was.rgb) and frame.depth_m.dtype == np.float32
        assert np.array_equal(np.isnan(frame.depth_m), np.isnan(was.depth_m))
        assert np.nanmax(np.abs(frame.depth_m - was.depth_m)) <= error_m
    assert recording.frame() is None


def test_what_is_no_recording_says_so(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="is no recording"):
        Recording(tmp_path)
    (tmp_path / INDEX).write_text("{}")
    with pytest.raises(SourceError, match="record the folder again"):
        Recording(tmp_path)


def test_a_recording_with_missing_or_wrong_pictures_says_so(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path)
    recorder.add(picture(5))
    recorder.close()
    with pytest.raises(SourceError, match="already holds"):
        Recorder(tmp_path)
    index = json.loads((tmp_path / INDEX).read_text())
    (tmp_path / INDEX).write_text(json.dumps({**index, "width_px": 80}))
    with pytest.raises(SourceError, match="80 x 6"):
        Recording(tmp_path).frame()
    (tmp_path / INDEX).write_text(json.dumps(index))
    Image.fromarray(np.zeros((3, 3, 3), np.uint8)).save(tmp_path / "000000.png")
    with pytest.raises(SourceError, match="3 x 3"):
        Recording(tmp_path).frame()
    (tmp_path / "000000.depth.png").write_bytes(b"no picture")
    with pytest.raises(SourceError, match="frame 0"):
        Recording(tmp_path).frame()


def fake_sdk(state: str = "SUCCESS", grabbed: str = "SUCCESS", opened: bool = True) -> SimpleNamespace:
    """``pyzed.sl`` as far as it is used."""
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
        InitParameters=SimpleNamespace, Camera=Camera, Mat=Mat, RESOLUTION=SimpleNamespace(HD720="HD720"),
        UNIT=SimpleNamespace(METER="METER"), DEPTH_MODE=SimpleNamespace(ULTRA="ULTRA"),
        ERROR_CODE=SimpleNamespace(SUCCESS="SUCCESS"), VIEW=SimpleNamespace(LEFT="LEFT"),
        MEASURE=SimpleNamespace(DEPTH="DEPTH"), TIME_REFERENCE=SimpleNamespace(IMAGE="IMAGE"),
    )  # fmt: skip


def test_a_zed_gives_its_own_intrinsics_rgb_and_nan_for_all_that_is_unknown() -> None:
    sdk = fake_sdk()
    camera = ZedCamera("front", sdk=sdk)
    frame = camera.frame()
    assert frame is not None and frame.intrinsics == Intrinsics(3, 2, 5.0, 5.5, 1.0, 0.5)
    assert frame.stamp_ns == 77 and frame.rgb[0, 0].tolist() == [3, 2, 1]
    assert np.array_equal(frame.depth_m, np.array([[1.0, np.nan, np.nan], [np.nan, 2.5, np.nan]]), equal_nan=True)
    camera.close()
    assert sdk.Camera.closed


def test_a_zed_that_cannot_be_opened_is_late_or_gone_says_so() -> None:
    with pytest.raises(SourceError, match="cannot be opened: CAMERA NOT DETECTED"):
        ZedCamera("front", sdk=fake_sdk(state="CAMERA NOT DETECTED"))
    with pytest.raises(SourceError, match="no resolution 'HD9'"):
        ZedCamera("front", "HD9", sdk=fake_sdk())
    assert ZedCamera("front", sdk=fake_sdk(grabbed="TIMEOUT")).frame() is None
    with pytest.raises(SourceError, match="is gone: UNPLUGGED"):
        ZedCamera("front", sdk=fake_sdk(grabbed="UNPLUGGED", opened=False)).frame()


def test_without_its_sdk_a_zed_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyzed", None)
    with pytest.raises(SourceError, match="pyzed") as told:
        ZedCamera("front")
    assert "\n" not in str(told.value)


class Server:
    """Answers questions on a free port with what ``answers`` gives: bytes, or None to hang up."""

    def __init__(self, answers) -> None:
        self._answers, self.asked = iter(answers), []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            with client:
                while head := client.recv(QUESTION.size):
                    self.asked.append(client.recv(question_bytes(head)).decode())
                    parts = next(self._answers, None)
                    if parts is None:
                        break
                    for wait_s, data in parts:
                        time.sleep(wait_s)
                        client.sendall(data)

    def close(self) -> None:
        self._listener.close()


def wire(stamp_ns: int) -> bytes:
    depth = np.array([[0, 1500], [65535, 2]], "<u2")
    return encode(RgbdMessage("front", stamp_ns, 2, 2, 3.0, 3.0, 0.5, 0.5, bytes(range(12)), depth.tobytes()))


def test_the_newest_frame_is_asked_for_and_unknown_depth_is_nan() -> None:
    server = Server([[(0.0, wire(1))], [(0.0, wire(2))]])
    camera = StreamCamera(server.address, "front", timeout_s=5.0)
    frame, later = camera.frame(), camera.frame()
    assert frame is not None and later is not None and (frame.stamp_ns, later.stamp_ns) == (1, 2)
    assert frame.rgb.tolist()[0][1] == [3, 4, 5] and camera.problem == ""
    assert np.array_equal(frame.depth_m, np.array([[np.nan, 1.5], [65.535, 0.002]], np.float32), equal_nan=True)
    assert server.asked == ["front", "front"]
    camera.close()
    server.close()


def test_a_slow_frame_is_not_waited_for_and_not_lost() -> None:
    data = wire(7)
    server = Server([[(0.0, data[:30]), (0.25, data[30:])]])
    camera = StreamCamera(server.address, "front", timeout_s=0.1)
    assert camera.frame() is None and "within 100 ms" in camera.problem
    frame = None
    for _ in range(100):
        frame = frame or camera.frame()
    assert frame is not None and frame.stamp_ns == 7 and server.asked == ["front"]
    camera.close()
    server.close()


def test_broken_frames_refusals_and_hangups_are_told_and_the_next_call_connects_anew() -> None:
    broken = bytearray(wire(1))
    broken[-1] ^= 1
    server = Server(
        [[(0.0, bytes(broken))], [(0.0, encode_refusal("front", "no such camera"))], None, [(0.0, wire(3))]]
    )
    camera = StreamCamera(server.address, "front", timeout_s=5.0)
    for words in ("checksum", "no such camera", "hung up"):
        assert camera.frame() is None and words in camera.problem
    frame = camera.frame()
    assert frame is not None and frame.stamp_ns == 3 and camera.problem == ""
    camera.close()
    server.close()


def test_nobody_there_is_a_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    camera = StreamCamera(address, "front", timeout_s=0.5)
    assert camera.frame() is None and address in camera.problem
    assert StreamCamera("nonsense", "front").frame() is None
    missing = StreamCamera("unix:/nowhere/socket", "front")
    assert missing.frame() is None and "/nowhere/socket" in missing.problem
