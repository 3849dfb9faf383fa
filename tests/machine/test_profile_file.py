"""Loading profiles: names, paths, content hash, keys, types, files that cannot be read."""

from __future__ import annotations

import pickle
import re
import zlib

import msgspec
import pytest

from machine.joints import JOINTS, Joint
from machine.loading.profile_file import ProfileError, load_profile, profile_hash, shipped_profiles
from machine.profile import Imu, Profile, Sag, joint, joint_limits
from tests.codes import coded, numbers_in
from tests.machine.changed_profiles import AORO, DELETE, FOLDER, IMU, RAW, SAG, SHIPPED, the_problem, write


def test_shipped_profile_loads_by_name_and_by_path(tmp_path):
    assert shipped_profiles() == ("aoro_fc8", "palms_471")
    by_name = load_profile("palms_471")
    assert by_name == load_profile(SHIPPED) == load_profile(str(SHIPPED))
    assert by_name == load_profile(write(tmp_path, {}))
    assert by_name.name == "palms_471" and by_name.machine_bus is None


def test_access_by_enum():
    profile = load_profile("palms_471")
    assert [joint(profile, j) for j in JOINTS] == [profile.joints[n] for n in ("slew", "lift", "tilt", "ext", "rot")]
    assert joint_limits(profile)[Joint.EXT] == (0.13, 1.80)


@pytest.mark.parametrize("name", ["palms_471", "aoro_fc8"])
def test_every_value_of_a_shipped_profile_has_its_source(name):
    for line in (FOLDER / f"{name}.toml").read_text().splitlines():
        if " = " in line and not line.startswith("#"):
            assert re.search(r"# .*\[(A|B|FPI|XT28|man|derived|mem|est|set)\]", line), line


def test_the_forwarder_is_blind_in_rotator_and_opening_and_has_a_carrier():
    profile = load_profile("aoro_fc8")
    assert [j for j in JOINTS if joint(profile, j).encoder is None] == [Joint.ROT]
    assert not profile.grapple.opening_sensor and load_profile("palms_471").grapple.opening_sensor
    assert profile.machine_bus == "mach0"
    assert profile.carrier is not None and profile.carrier.articulation_encoder.message == "EncArtic"
    assert profile.carrier.cruise_speed_m_s == pytest.approx(2.3 / 3.6, abs=1e-3)
    assert set(profile.cameras) == {"front"} and set(load_profile("palms_471").cameras) == {"stick", "d435"}


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


def test_a_joint_without_encoder_and_a_second_bus_are_allowed(tmp_path):
    profile = load_profile(write(tmp_path, {"joints.rot.encoder": DELETE, "machine_bus": "mach0"}))
    assert profile.joints["rot"].encoder is None and profile.machine_bus == "mach0"


# One row per mistake: what is changed, and code, key path and named words of the only problem.
STRUCTURE = [
    (
        {"joints.lift.lower_deg": -22.0, "joints.lift.lower": DELETE},
        "profile.wrong-unit",
        "joints.lift.lower_deg",
        ('"lower"',),
    ),
    ({"kinematics.d1_mm": 1364.34, "kinematics.d1_m": DELETE}, "profile.wrong-unit", "kinematics.d1_mm", ('"d1_m"',)),
    (
        {"joints.slew.speed_limit_deg_s": 20.0},
        "profile.wrong-unit",
        "joints.slew.speed_limit_deg_s",
        ('"speed_limit"',),
    ),
    (
        {"joints.slew.valve.dedband_plus_pct": 3.0},
        "profile.unknown-key",
        "joints.slew.valve.dedband_plus_pct",
        ('"deadband_plus_pct"',),
    ),
    ({"timeouts.zzz": 1}, "profile.unknown-key", "timeouts.zzz", ()),
    ({"rate": 200}, "profile.wrong-unit", "rate", ('"rate_hz"',)),
    ({"joints.boom": RAW["joints"]["lift"]}, "profile.unknown-joint", "joints.boom", ()),
    ({"joints.slw": RAW["joints"]["slew"]}, "profile.unknown-joint", "joints.slw", ('"slew"',)),
    ({"joints.ext": DELETE}, "profile.missing-joint", "joints.ext", ()),
    ({"joints.ext.law": DELETE}, "profile.missing-key", "joints.ext.law", ()),
    ({"bunk": DELETE}, "profile.missing-key", "bunk", ()),
    ({"bunk": 3}, "profile.not-a-table", "bunk", ("3",)),
    ({"joints": 3}, "profile.not-a-table", "joints", ("3",)),
    ({"joints.lift.lower": "-22 deg"}, "profile.wrong-type", "joints.lift.lower", ()),
    ({"rate_hz": 200.5}, "profile.wrong-type", "rate_hz", ()),
    ({"bunk.center_m": [1.0]}, "profile.wrong-type", "bunk.center_m", ("2", "1")),
    ({"bunk.center_m": [1.0, "x"]}, "profile.wrong-type", "bunk.center_m[1]", ()),
    ({"cameras": 3}, "profile.not-a-table", "cameras", ("3",)),
    (
        {"cameras.stick.fx": 530.0, "cameras.stick.fx_px": DELETE},
        "profile.wrong-unit",
        "cameras.stick.fx",
        ('"fx_px"',),
    ),
    ({"cameras.d435.rate_hz": DELETE}, "profile.missing-key", "cameras.d435.rate_hz", ()),
    ({"cameras.d435.rpy_rad": [0.0, 1.57]}, "profile.wrong-type", "cameras.d435.rpy_rad", ("3", "2")),
    ({"carrier": 3}, "profile.not-a-table", "carrier", ("3",)),
    ({"schema": 2}, "profile.not-allowed", "schema", ("2", "1")),
    ({"joints.slew.valve.sign": 0}, "profile.not-allowed", "joints.slew.valve.sign", ("0", "-1", "1")),
    ({"joints.slew.valve.sign": True}, "profile.not-allowed", "joints.slew.valve.sign", ("-1", "1")),
    ({"joints.slew.encoder.kind": "round"}, "profile.not-allowed", "joints.slew.encoder.kind", ()),
    ({"joints.slew.encoder.direction": [1]}, "profile.not-allowed", "joints.slew.encoder.direction", ("1", "-1")),
]


@pytest.mark.parametrize(("changes", "code", "path", "named"), STRUCTURE, ids=lambda v: "")
def test_wrong_keys_and_types(tmp_path, changes, code, path, named):
    found, sentence = the_problem(tmp_path, changes)
    assert found == (code, path)
    assert all(word in sentence for word in named)


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


def test_unreadable_files_are_named(tmp_path):
    gone = tmp_path / "gone.toml"
    with pytest.raises(ProfileError, check=coded("profile.unreadable")) as caught:
        load_profile(str(gone))
    assert str(gone) in str(caught.value)
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"a = 1\n\xff\xfe")
    with pytest.raises(ProfileError, check=coded("profile.not-utf8")) as caught:
        load_profile(binary)
    assert str(binary) in str(caught.value) and 6 in numbers_in(str(caught.value).replace(str(binary), ""))


def test_broken_toml_names_the_line(tmp_path):
    broken = tmp_path / "broken.toml"
    broken.write_text('schema = 1\nname = "x"\nrate_hz = = 3\n')
    with pytest.raises(ProfileError, check=coded("profile.broken-toml")) as caught:
        load_profile(broken)
    assert str(broken) in str(caught.value)
    assert numbers_in(str(caught.value).replace(str(broken), "")) == [3, 11]


def test_an_error_keeps_its_problems_between_processes(tmp_path):
    with pytest.raises(ProfileError) as caught:
        load_profile(write(tmp_path, {"rate_hz": 300}))
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (copy.code, str(copy), copy.problems) == (caught.value.code, str(caught.value), caught.value.problems)


def test_profiles_are_frozen():
    profile = load_profile("palms_471")
    assert isinstance(profile, Profile)
    with pytest.raises(AttributeError):
        profile.rate_hz = 100  # type: ignore[misc]


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
