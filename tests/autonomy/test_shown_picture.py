"""The picture that is shown: the detector's own frame, small, outlined, and with each log where the camera saw it."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from PIL import Image

from autonomy.perception.camera.frame import RgbdFrame, optical_pose
from autonomy.perception.log_list import LogObservation
from autonomy.perception.shown_picture import OUTLINE, MeasuredPicture, NewestPicture
from can_dbc.messages.picture import (
    MAX_DATAGRAM_BYTES,
    MAX_JPEG_BYTES,
    decode_picture,
    encode_picture_request,
    picture_request,
)
from machine.geometry.optics import intrinsics
from machine.loading.profile_file import load_profile
from runtime.errors import InputRefused
from tests.codes import coded

PROFILE = load_profile("palms_471")
CAMERA = PROFILE.cameras["stick"]
PIN = intrinsics(CAMERA)
POSE = optical_pose(PROFILE, CAMERA, (0.2, 0.6, -1.2, 0.3, 0.0))


class Mask:
    def __init__(self, mask: np.ndarray) -> None:
        self.mask = mask


def measured(log: LogObservation, noise: int = 0) -> MeasuredPicture:
    rgb = np.full((PIN.height_px, PIN.width_px, 3), 90, np.uint8)
    if noise:
        rgb = np.random.default_rng(1).integers(0, noise, rgb.shape, np.uint8)
    mask = np.zeros(rgb.shape[:2], bool)
    mask[300:400, 500:700] = True
    return MeasuredPicture(
        RgbdFrame("stick", 5, rgb, np.full(rgb.shape[:2], 4.0, np.float32), PIN), POSE, [Mask(mask)], [log]
    )


def ahead(u_px: float, v_px: float, z_m: float) -> tuple[float, float, float]:
    """The base-frame point at a pixel and a depth."""
    x, y, z = POSE.to_base(PIN.deproject(u_px, v_px, z_m)).tolist()
    return x, y, z


def log_between(a: tuple[float, float, float], b: tuple[float, float, float]) -> LogObservation:
    length = math.dist(a, b)
    axis = tuple((q - p) / length for p, q in zip(a, b, strict=True))
    center = tuple(0.5 * (p + q) for p, q in zip(a, b, strict=True))
    return LogObservation(4, center, axis, length, 0.2)


LOG = log_between(ahead(400.0, 300.0, 4.0), ahead(800.0, 420.0, 5.0))


def kept(picture: MeasuredPicture) -> NewestPicture:
    pictures = NewestPicture("stick")
    pictures.keep(picture, 77)
    return pictures


def asked(pictures: NewestPicture, since_ns: int = 0) -> tuple:
    reply = pictures.reply(encode_picture_request(since_ns), "")
    assert reply is not None and len(reply) <= MAX_DATAGRAM_BYTES
    return decode_picture(reply)


def test_a_measured_log_is_drawn_where_the_camera_saw_it() -> None:
    facts, jpeg = asked(kept(measured(LOG)))
    picture = np.asarray(Image.open(io.BytesIO(jpeg)), int)
    assert picture.shape == (360, 640, 3) == (facts.height_px, facts.width_px, 3)
    (log,) = facts.logs
    assert log.id == 4 and log.seen and log.length_m == pytest.approx(LOG.length_m, abs=1e-3)
    assert log.ends_px == (pytest.approx((200.0, 150.0), abs=0.1), pytest.approx((400.0, 210.0), abs=0.1))
    near = np.abs(picture - np.array(OUTLINE)).sum(axis=2) < 120
    rows, columns = np.nonzero(near)
    assert near.sum() > 200, "the outline of the mask is drawn"
    assert (rows.min(), rows.max()) == pytest.approx((150, 199), abs=2)
    assert (columns.min(), columns.max()) == pytest.approx((250, 349), abs=2)


def test_pinhole_and_pose_of_a_reply_project_as_the_camera_does() -> None:
    facts, _ = asked(kept(measured(LOG)))
    point = np.array(ahead(640.0, 200.0, 3.0)) - facts.position_m
    x, y, z = point @ np.array(facts.rotation).reshape(3, 3)
    at = facts.fx_px * x / z + facts.cx_px, facts.fy_px * y / z + facts.cy_px
    assert at == pytest.approx((320.0, 100.0), abs=1e-6)


def test_a_picture_is_sent_once_and_a_log_behind_the_camera_has_no_place() -> None:
    pictures = NewestPicture("stick")
    assert asked(pictures) == (asked(pictures)[0], b"") and asked(pictures)[0].measured_ns == 0
    behind = log_between(ahead(400.0, 300.0, -2.0), ahead(400.0, 300.0, 2.0))
    pictures.keep(measured(behind), 77)
    facts, jpeg = asked(pictures)
    assert jpeg and facts.logs[0].ends_px is None
    facts, jpeg = asked(pictures, 77)
    assert (facts.measured_ns, jpeg) == (77, b"")


def test_a_noisy_picture_fits_into_a_datagram() -> None:
    assert 0 < len(asked(kept(measured(LOG, noise=255)))[1]) <= MAX_JPEG_BYTES


def test_why_there_is_no_newer_picture_is_told() -> None:
    pictures = NewestPicture("stick")
    reply = pictures.reply(encode_picture_request(), "the camera is unplugged")
    assert reply is not None and decode_picture(reply)[0].problem == "the camera is unplugged"


@pytest.mark.parametrize("data", [b"", b"{}", b'{"op":"logs"}', b'{"op":"picture","since_ns":"x"}', b"\xff", b"[1]"])
def test_other_datagrams_are_not_requests_for_a_picture(data: bytes) -> None:
    assert picture_request(data) is None
    assert NewestPicture("stick").reply(data, "") is None


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b'{"error":"unknown op \'picture\'"}', "picture.no-camera"),
        (b"", "picture.no-camera"),
        (b'{"schema":1,"camera":"x","measured_ns":3,"problem":""}\n\xff\xd8\xff', "picture.damaged"),
        (
            b'{"schema":1,"camera":"x","measured_ns":3,"problem":"","width_px":4,"height_px":4}\nGIF89a',
            "picture.damaged",
        ),
    ],
)
def test_what_is_no_picture_is_refused(data: bytes, code: str) -> None:
    with pytest.raises(InputRefused, check=coded(code)):
        decode_picture(data)


def test_a_small_frame_is_drawn_whole_and_stays_as_it_was() -> None:
    """A frame of a socket is read-only, and the detector goes on with it."""
    small, shape = PIN.scaled(0.25), (180, 320)
    rgb = np.full((*shape, 3), 90, np.uint8)
    rgb.setflags(write=False)
    mask = np.zeros(shape, bool)
    mask[50:90, 100:200] = True
    frame = RgbdFrame("stick", 5, rgb, np.full(shape, 4.0, np.float32), small)
    facts, jpeg = asked(kept(MeasuredPicture(frame, POSE, [Mask(mask)], [LOG])))
    assert (facts.width_px, facts.height_px) == (320, 180) and jpeg
    assert (rgb == 90).all()


def test_black_bars_are_left_out_and_what_is_seen_stays_in_its_place() -> None:
    framed = measured(LOG)
    framed.frame.rgb[:120] = framed.frame.rgb[600:] = 0
    facts, jpeg = asked(kept(framed))
    assert (facts.width_px, facts.height_px) == (640, 240) == Image.open(io.BytesIO(jpeg)).size
    assert facts.logs[0].ends_px == (pytest.approx((200.0, 90.0), abs=0.1), pytest.approx((400.0, 150.0), abs=0.1))
