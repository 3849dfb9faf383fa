"""The guard's envelope file: sealed, apart from the profile, and never exceeded by it; and the databases it demands."""

import itertools
import math
import re
import shutil
import zlib

import pytest

from can_dbc.dbc.codec import load as load_database
from controller.config import load as load_settings
from controller.crane.trajectory_check import WorkspaceCheck
from controller.guard import seal
from controller.guard.__main__ import DATABASES, build
from controller.guard.envelope import (
    _ENCODER,
    _LIMITS,
    _VALVE,
    SHIPPED,
    _axis,
    _limits,
    _number,
    _within,
    read_envelope,
)
from controller.guard.layout import GuardConfigError, read_layouts
from machine.geometry.bunk import stake_walls
from machine.geometry.grapple import lowest_pin_m
from machine.loading.profile_file import shipped_profiles
from tests.codes import coded
from tests.controller.guard_parts import AXIS_LIMITS, VALVE
from tests.controller.guard_traffic import PROFILE


@pytest.fixture
def files(tmp_path):
    """A profile with its envelope beside it."""
    profile, envelope = tmp_path / "calibrated.toml", tmp_path / "palms_471.envelope.toml"
    profile.write_text(PROFILE.read_text())
    envelope.write_text((SHIPPED / envelope.name).read_text())
    return profile, envelope


def rewrite(path, old, new):
    """Change one thing of a file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def refuses(profile, code="guard.profile-incomplete"):
    """The guard does not start with this profile."""
    with pytest.raises(GuardConfigError, check=coded(code)):
        build(profile)


@pytest.mark.parametrize("name", shipped_profiles())
def test_every_shipped_profile_has_a_sealed_envelope(name):
    envelope = read_envelope(SHIPPED / f"{name}.toml")
    assert len(envelope.axes) == 5 and (envelope.carrier is not None) == (name == "aoro_fc8")
    assert envelope.boxes


def test_the_envelope_beside_the_profile_counts(files):
    profile, envelope = files
    rewrite(envelope, "ground_m = -0.565", "ground_m = -0.5")
    refuses(profile, "guard.envelope-damaged")
    assert seal.main([str(envelope)]) == 0
    assert read_envelope(profile).ground_m == -0.5
    assert envelope.read_text().count("sha256") == 1
    assert seal.main([str(envelope)]) == 0, "once more changes nothing"
    assert read_envelope(profile).ground_m == -0.5


def test_any_changed_byte_stops_the_start(files):
    profile, envelope = files
    good = envelope.read_bytes()
    for at in range(0, len(good) - 1, 97):
        envelope.write_bytes(good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :])
        with pytest.raises(GuardConfigError):
            build(profile)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("upper = 1.74533 ", "upper = 1.75 "),
        ("lower = -0.383972 ", "lower = -0.4 "),
        ("speed_limit = 0.28 ", "speed_limit = 0.3 "),
        ("acceleration_limit = 0.45 ", "acceleration_limit = 0.5 "),
    ],
)
def test_a_profile_that_allows_more_is_refused(files, old, new):
    rewrite(files[0], old, new)
    refuses(files[0], "guard.profile-exceeds-envelope")


def test_what_calibration_finds_is_taken_from_the_profile(files):
    profile, _ = files
    text = profile.read_text().replace("deadband_plus_pct = 12.0", "deadband_plus_pct = 9.0", 1)
    profile.write_text(
        text.replace("zero_counts = 8192 ", "zero_counts = 8100 ", 1).replace("upper = 1.74533", "upper = 1.7")
    )
    slew = read_envelope(profile).axes[0]
    assert (slew.deadbands_pct, slew.zero_counts, slew.upper) == ((12.0, 9.0), 8100, 1.74533)


def test_a_machine_without_an_envelope_does_not_start(files, capsys):
    profile, _ = files
    rewrite(profile, 'name = "palms_471"', 'name = "unknown"')
    refuses(profile, "guard.envelope-missing")
    assert seal.main([str(profile.with_name("none"))]) == 3
    assert "none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("deadband_plus_pct = 12.0", "deadband_plus_pct = nan"),
        ("deadband_plus_pct = 12.0", "deadband_plus_pct = 100.0"),
        ("full_speed_plus = ", "full_speed_plus = inf # "),
        ("total_counts = ", "total_counts = inf # "),
        ("rate_hz = ", "rate_hz = inf # "),
        ("rate_hz = 200", "rate_hz = 2" + 399 * "0"),
        ("rate_hz = 200", "rate_hz = 40"),
        ("\nsign = ", "\nsign = 0 # "),
        ("delay_s = ", "delay_s = 1e6 # "),
        ("upper = 1.309", "upper = nan"),
        ("lower = -0.383972", "lower = 1.4"),
        ("direction = ", "direction = 0 # "),
        ("unit_per_count = ", "unit_per_count = 0.0 # "),
        ('message = "EncSlew"', 'message = "EncLift"'),
        ('message = "EncExt"', 'message = "EncTilt"'),
        ('signal = "Slew"', 'signal = "Lift"'),
        ('kind = "linear"', 'kind = "rotary"'),
    ],
)
def test_numbers_that_would_switch_a_rule_off_or_end_the_guard_stop_the_start(files, old, new):
    profile, _ = files
    text = profile.read_text()
    assert old in text
    changed = text.replace(old, new)
    for name, value in (("full_speed", "inf"), ("deadband", "100.0")):
        if name in old and "nan" not in new:  # the better side counts, so both must be bad
            changed = re.sub(rf"({name}_\w+) = [^ ]+", rf"\1 = {value}", changed)
    profile.write_text(changed)
    refuses(profile)


def resealed(envelope, old, new):
    """Change an envelope file as its owner may: with a new seal."""
    rewrite(envelope, old, new)
    assert seal.main([str(envelope)]) == 0


GROUND = "ground_m = -0.565"
FIRST_BOX = "[[boxes]]\nlow_m = [-1.0, -1.0, -1.0]\nhigh_m = {}\n\n[[boxes]]"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *((GROUND, f"ground_m = {value}") for value in ("nan", "inf", '"a text"', "[1.0]", 5000 * "[" + 5000 * "]")),
        ("lower = -1.74533\nupper = 1.74533", "lower = 1.74533\nupper = -1.74533"),
        ("speed_limit = 0.35", "speed_limit = -0.35"),
        ("acceleration_limit = 0.4", "acceleration_limit = 0.0"),
        ("high_m = [0.4, 0.4, 1.5]", "high_m = [0.4, -0.5, 1.5]"),
        ("[[boxes]]", FIRST_BOX.format("[9.0, 9.0, -9.0]")),  # one of several, with its corners the wrong way round
        ("[[boxes]]", FIRST_BOX.format("[-1.0, 9.0, 9.0]")),  # or on one face
    ],
    ids=lambda text: text[:30],
)
def test_a_sealed_envelope_that_no_machine_has_stops_the_start(files, old, new):
    profile, envelope = files
    resealed(envelope, old, new)
    refuses(profile)


def carrier_with_speed_limit(folder, limit):
    """A profile of the forwarder that is as fast as this."""
    text = re.sub(
        r"(?m)^speed_limit_m_s = [\d.]+", f"speed_limit_m_s = {limit}", (SHIPPED / "aoro_fc8.toml").read_text()
    )
    (folder / "machine.toml").write_text(text)
    return folder / "machine.toml"


@pytest.mark.parametrize(
    ("limit", "taken"), [(0.0007, False), (0.001, True), (0.7, True), (7.0, True), (10.0, True), (10.5, False)]
)
def test_a_limit_of_the_carrier_has_bounds(tmp_path, limit, taken):
    profile, envelope = carrier_with_speed_limit(tmp_path, "0.0001"), tmp_path / "aoro_fc8.envelope.toml"
    envelope.write_text((SHIPPED / envelope.name).read_text())
    old = re.search(r"(?m)^speed_limit_m_s = [\d.]+", envelope.read_text())
    assert old is not None
    resealed(envelope, old[0], f"speed_limit_m_s = {limit}")
    if taken:
        carrier = read_envelope(profile).carrier
        assert carrier is not None and carrier.speed_limit_m_s == limit
    else:
        refuses(profile)


def test_a_limit_of_the_carrier_that_is_no_number_stops_the_start(tmp_path):
    refuses(carrier_with_speed_limit(tmp_path, "nan"))


def test_the_check_of_a_profile_has_24_bits(files):
    profile, _ = files
    text = profile.read_text()
    for k in range(64):
        content = f"{text}# {k}\n".encode()
        if zlib.crc32(content) & 0x800000:
            break
    profile.write_bytes(content)
    assert read_envelope(profile).profile_check == zlib.crc32(content) & 0xFFFFFF


@pytest.mark.parametrize("value", ["1.0", None, math.inf, math.nan])
def test_what_is_no_finite_number_is_no_limit(value):
    with pytest.raises(ValueError):
        _number(value)


def test_a_number_may_be_at_either_end_of_its_range():
    ends = {"a": 1.0, "b": 2.0}
    assert _within(ends, {"a": (1.0, 2.0), "b": (1.0, 2.0)}) == ends
    with pytest.raises(ValueError):
        _within({"a": 2.1}, {"a": (1.0, 2.0)})


@pytest.mark.parametrize(
    ("table", "key", "low", "high"),
    [
        (_VALVE, "deadband_plus_pct", 0.0, 49.99),
        (_VALVE, "deadband_minus_pct", 0.0, 49.99),
        (_VALVE, "full_speed_plus", 0.001, 20.0),
        (_VALVE, "full_speed_minus", 0.001, 20.0),
        (_VALVE, "delay_s", 0.0, 0.5),
        (_VALVE, "lag_s", 0.0, 0.3),
        (_ENCODER, "total_counts", 2, 4_294_967_296),
        (_ENCODER, "zero_counts", -2_147_483_648, 4_294_967_296),
        (_ENCODER, "unit_per_count", 1e-9, 0.1),
        (_LIMITS, "lower", -20.0, 20.0),
        (_LIMITS, "upper", -20.0, 20.0),
        (_LIMITS, "speed_limit", 0.001, 10.0),
        (_LIMITS, "acceleration_limit", 0.01, 20.0),
    ],
)
def test_a_number_of_a_machine_is_refused_just_outside_its_range(table, key, low, high):
    for value in (low, high):
        assert _within({key: value}, {key: table[key]}) == {key: value}
    below = low - 1 if isinstance(low, int) else low - 0.1 * (abs(low) or high)
    above = high + 1 if isinstance(high, int) else 1.001 * high
    for value in (below, above):
        with pytest.raises(ValueError):
            _within({key: value}, {key: table[key]})


def test_a_joint_without_a_range_has_no_limits():
    with pytest.raises(ValueError):
        _limits({"lower": 1.0, "upper": 1.0, "speed_limit": 1.0, "acceleration_limit": 1.0})


def test_a_spool_s_time_to_close_is_exact_to_the_nanosecond():
    valve = {"valve": VALVE | {"delay_s": 0.5, "lag_s": 0.25}}
    assert _axis(2, valve, AXIS_LIMITS).closing_ns == 1_500_000_000


@pytest.mark.parametrize(("rate_hz", "beyond_hz"), [(50, 49), (1000, 1001)])
def test_a_control_rate_may_be_at_either_end_of_its_range(rate_hz, beyond_hz):
    build(PROFILE, rate_hz=rate_hz)
    with pytest.raises(GuardConfigError, check=coded("guard.rate")):
        build(PROFILE, rate_hz=beyond_hz)


@pytest.mark.parametrize("damage", [b"\x81", b"@1+ (x,0)", b"0|99999999999@1+ (1,0)"])
def test_a_database_with_numbers_or_bytes_that_cannot_be_read_stops_the_start(tmp_path, damage):
    text = (DATABASES / "crane.dbc").read_bytes()
    path = tmp_path / "crane.dbc"
    path.write_bytes(text.replace(b"@1+ (1,0)", damage).replace(b"0|8@1+ (1,0)", damage))
    with pytest.raises(GuardConfigError):
        read_layouts(path, ["ValveCmdA"])


@pytest.mark.parametrize("text", ["rate_hz = 2" + 5000 * "0", "x = " + 5000 * "[" + 5000 * "]"])
def test_a_profile_that_no_reader_can_read_stops_the_start(files, text):
    files[0].write_text(text)
    refuses(files[0], "guard.profile-unreadable")


def test_guard_and_controller_have_one_check_of_one_file(files):
    profile, _ = files
    check = load_settings(profile).file_check
    assert 0 < check == read_envelope(profile).profile_check == load_settings("palms_471").file_check
    codec = load_database("crane").messages["GuardStat"]
    told = [codec.decode(data) for key, data in build(profile).step(10**9, []) if key == codec.key]
    assert told and all(values[codec.index["ProfileCheck"]] == check for values in told)
    profile.write_text(profile.read_text() + "\n# changed after the controller's start\n")
    assert read_envelope(profile).profile_check != check


@pytest.mark.parametrize("name", shipped_profiles())
def test_the_guard_stops_nothing_that_the_controller_lets_pass(name):
    """A box around the crane's own column is out of its reach; every other one is a keep-out of the profile."""
    profile = load_settings(name).profile
    check = WorkspaceCheck(profile)
    for low, high in read_envelope(SHIPPED / f"{name}.toml").boxes:
        if low[0] < 0.0 < high[0] and low[1] < 0.0 < high[1]:
            continue
        heights = (max(low[2], min(b.center_m[2] - b.half_m[2] for b in profile.keep_out.values())), 0.0, high[2])
        for x, y, z in itertools.product((low[0], -2.0, high[0]), (low[1], 0.0, high[1]), heights):
            assert check._box_at(x, y, z) >= len(stake_walls(profile.bunk)), (x, y, z)
    assert lowest_pin_m(profile) >= read_envelope(SHIPPED / f"{name}.toml").ground_m + 0.04


# -- databases


@pytest.fixture
def databases(tmp_path):
    for name in ("crane.dbc", "machine.dbc"):
        shutil.copy(DATABASES / name, tmp_path)
    return tmp_path


ESTOP = f"BO_ {load_database('crane').message('EstopStat').key} "


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        (f'BA_ "E2EDataIds" {ESTOP}"', f'BA_ "E2EDataIds" {ESTOP}"01 ', "guard.data-ids"),
        (f'BA_ "TimeoutMs" {ESTOP}', f'BA_ "Other" {ESTOP}', "guard.message-unprotected"),
        (" SG_ Slew : ", " SG_ Swing : ", "guard.no-command-signal"),
    ],
)
def test_a_database_without_protection_time_out_or_signal_stops_the_start(databases, old, new, code):
    path = databases / "crane.dbc"
    text = path.read_text(encoding="cp1252")
    assert old in text and not build(PROFILE, databases).enabled
    path.write_text(text.replace(old, new, 1), encoding="cp1252")
    with pytest.raises(GuardConfigError, check=coded(code)):
        build(PROFILE, databases)


def test_a_database_that_is_not_there_stops_the_start(databases):
    (databases / "crane.dbc").unlink()
    with pytest.raises(GuardConfigError, check=coded("guard.dbc-unreadable")):
        build(PROFILE, databases)
