"""Loading profiles: names, paths, content hash, files that cannot be read; their DBC, and the envelope beside them."""

from __future__ import annotations

import pickle
import re
import zlib

import msgspec
import pytest

from can_dbc.dbc import codec
from controller.guard.__main__ import build, profile_path
from controller.guard.layout import GuardConfigError
from machine.loading.checks import IMU_MESSAGE
from machine.loading.profile_file import ProfileError, carry_envelope, load_profile, profile_hash, shipped_profiles
from machine.loading.ranges import _RANGES
from machine.profile import Carrier, Imu, Sag
from tests.codes import coded, numbers_in
from tests.machine.changed_profiles import AORO, DELETE, FOLDER, IMU, SAG, SHIPPED, write
from tests.machine.own_machine import NAME, made


def test_shipped_profile_loads_by_name_and_by_path(tmp_path):
    assert shipped_profiles() == ("aoro_fc8", "palms_471")
    by_name = load_profile("palms_471")
    assert by_name == load_profile(SHIPPED) == load_profile(str(SHIPPED))
    assert by_name == load_profile(write(tmp_path, {}))
    assert by_name.name == "palms_471" and by_name.machine_bus is None


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_every_value_of_a_shipped_profile_has_its_source(name):
    for line in (FOLDER / f"{name}.toml").read_text().splitlines():
        if " = " in line and not line.startswith("#"):
            assert re.search(r"# .*\[(A|B|FPI|XT28|man|derived|mem|est|set)\]", line), line


def test_a_machine_may_have_no_carrier_and_no_cameras(tmp_path):
    profile = load_profile(write(tmp_path, {"cameras": DELETE}))
    assert profile.cameras == {} and profile.carrier is None
    standing = load_profile(write(tmp_path, {"carrier": DELETE, "cameras": DELETE, "machine_bus": DELETE}, AORO))
    assert standing.carrier is None and standing.machine_bus is None


def test_hash_is_a_u32_of_the_content_only(tmp_path):
    profile = load_profile("palms_471")
    wanted = profile_hash(profile)
    assert 0 <= wanted < 2**32
    assert profile_hash(load_profile(write(tmp_path, {}))) == wanted  # no comments, another layout
    turned = msgspec.structs.replace(profile, joints=dict(reversed(profile.joints.items())))
    assert profile_hash(turned) == wanted
    assert profile_hash(load_profile(write(tmp_path, {"joints.lift.law.kp_1_s": 2.001}))) != wanted
    assert profile_hash(load_profile(write(tmp_path, {"joints.lift.law.kp_1_s": 2}))) == wanted  # 2 is 2.0


def test_sag_is_optional_and_part_of_the_hash(tmp_path):
    assert load_profile("palms_471").sag is None
    leaning = load_profile(write(tmp_path, {"sag": SAG}))
    assert leaning.sag == Sag(**SAG)
    assert profile_hash(leaning) != profile_hash(load_profile("palms_471"))


def test_no_shipped_machine_has_an_imu_and_missing_late_sections_are_not_hashed(tmp_path):
    for name in shipped_profiles():
        profile = load_profile(name)
        assert profile.imu is None
        early = msgspec.structs.replace(profile, stability=None, keep_out={})
        content = msgspec.json.decode(msgspec.json.encode(early, order="deterministic"))
        del content["imu"], content["stability"], content["keep_out"], content["timeouts"]["operator_link_ms"]
        assert profile_hash(early) == zlib.crc32(msgspec.json.encode(content)) != profile_hash(profile)
    sensing = load_profile(write(tmp_path, {"imu": IMU}, AORO))
    assert sensing.imu == Imu(**IMU)
    assert profile_hash(sensing) != profile_hash(load_profile("aoro_fc8"))


def test_the_limit_of_the_operators_link_is_a_second_unless_a_machine_says_otherwise(tmp_path):
    shipped = load_profile("palms_471")
    early = load_profile(write(tmp_path, {"timeouts.operator_link_ms": DELETE}))
    assert early.timeouts.operator_link_ms == shipped.timeouts.operator_link_ms == 1000
    assert profile_hash(early) == profile_hash(shipped)
    for limit_ms in (0, 500, 999):
        other = load_profile(write(tmp_path, {"timeouts.operator_link_ms": limit_ms}))
        assert other.timeouts.operator_link_ms == limit_ms and profile_hash(other) != profile_hash(shipped)


def test_unknown_name_lists_the_shipped_profiles():
    names = ", ".join(shipped_profiles())
    with pytest.raises(ProfileError, check=coded("profile.unknown-name")) as caught:
        load_profile("palms_417")
    assert all(name in str(caught.value) for name in ('"palms_417"', '"palms_471"', names))
    with pytest.raises(ProfileError, check=coded("profile.unknown-name")) as caught:
        load_profile("volvo")
    assert '"volvo"' in str(caught.value) and '"palms_471"' not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "code", "place"),
    [
        (None, "profile.unreadable", []),
        (b"a = 1\n\xff\xfe", "profile.not-utf8", [8, 6]),  # UTF-8, and the byte
        (b'schema = 1\nname = "x"\nrate_hz = = 3\n', "profile.broken-toml", [3, 11]),
    ],
    ids=["missing", "not UTF-8", "no TOML"],
)
def test_an_unreadable_file_is_named_with_the_place_in_it(tmp_path, content, code, place):
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ProfileError, check=coded(code)) as caught:
        load_profile(str(path))
    assert str(path) in str(caught.value)
    assert numbers_in(str(caught.value).replace(str(path), "")) == place


def test_an_error_keeps_its_problems_between_processes(tmp_path):
    with pytest.raises(ProfileError) as caught:
        load_profile(write(tmp_path, {"rate_hz": 300}))
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (copy.code, str(copy), copy.problems) == (caught.value.code, str(caught.value), caught.value.problems)


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("schema = 1", "schema = 1\nx = " + 5000 * "[" + 5000 * "]", "profile.broken-toml"),
        ("rate_hz = 200", "rate_hz = 2" + 5000 * "0", "profile.broken-toml"),
        ("rate_hz = 200", "rate_hz = 2" + 399 * "0", "profile.out-of-range"),
    ],
)
def test_brackets_and_digits_beyond_what_python_reads_are_refused_in_a_sentence(tmp_path, old, new, code):
    path = tmp_path / "deep.toml"
    path.write_text(SHIPPED.read_text().replace(old, new))
    with pytest.raises(ProfileError, check=coded(code)):
        load_profile(path)


# -- the database, and the envelope


@pytest.mark.parametrize("name", shipped_profiles())
def test_every_encoder_and_valve_of_a_profile_is_in_the_dbc(name: str) -> None:
    crane = codec.load("crane")
    commands = {s.name for m in ("ValveCmdA", "ValveCmdB") for s in crane.message(m).signals}
    profile = load_profile(name)
    encoders = [joint.encoder for joint in profile.joints.values()]
    if profile.carrier is not None:
        encoders.append(profile.carrier.articulation_encoder)
    assert all(joint.valve.signal in commands for joint in profile.joints.values())
    for encoder in filter(None, encoders):
        message = crane.message(encoder.message)
        assert message.key == 0x180 + encoder.node, "TPDO1 of the encoder's node"
        assert "Position" in message.index


def test_the_only_message_of_a_sensor_on_the_grapple_is_in_the_dbc() -> None:
    message = codec.load("crane").message(IMU_MESSAGE)
    assert message.key == 0x180 + 0x23, "TPDO1 of node 23h"


@pytest.mark.parametrize(
    ("limit", "signal"), [("articulation_rate_limit_rad_s", "ArticRate"), ("speed_limit_m_s", "Speed")]
)
def test_every_carrier_limit_that_a_profile_may_have_fits_its_command(limit: str, signal: str) -> None:
    """A command out of the DBC's range is refused by the codec, and would end the tick."""
    message = codec.load("machine").message("VehCmd")
    values = [0.0] * len(message.signals)
    for side in (-1.0, 1.0):
        values[message.index[signal]] = side * _RANGES[Carrier][limit][1]
        assert message.encode(*values)


def test_a_changed_copy_elsewhere_takes_the_envelope_along(tmp_path):
    profile, copy = made(tmp_path / "mine"), tmp_path / "changed" / "calibrated.toml"
    copy.parent.mkdir()
    copy.write_text(profile.read_text())
    with pytest.raises(GuardConfigError, check=coded("guard.envelope-missing")):
        build(copy)
    carry_envelope(profile, copy.parent)
    build(copy)
    assert [p.name for p in sorted(copy.parent.iterdir())] == ["calibrated.toml", f"{NAME}.envelope.toml"]


def test_a_shipped_envelope_is_not_copied(tmp_path):
    carry_envelope(profile_path("palms_471"), tmp_path)
    assert list(tmp_path.iterdir()) == []
