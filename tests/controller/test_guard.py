"""The guard alone, rule by rule, and together with the controller on the bench."""

import ast
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.e2e import Sender, crc8
from controller.guard.__main__ import build, main
from controller.guard.envelope import read_envelope
from controller.guard.guard import Guard
from controller.guard.layout import GuardConfigError, read_layouts
from controller.guard.stream import checksum
from controller.guard.verdicts import Verdict
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.codes import coded
from tests.controller.bench import DATABASE, MACHINE, MS, Bench, T
from tests.controller.guard_traffic import PROFILE, Traffic, encoder_frozen, outside, spoil


def test_enables_after_200_ms_without_a_broken_rule():
    traffic = Traffic()
    traffic.tick()
    assert traffic.status[-1]["Enable"] == 0
    traffic.good()
    assert traffic.status[-1]["Enable"] == 0xA and traffic.status[-1]["Verdict"] == 0
    n, sent = len(traffic.status), []
    for _ in range(200):
        traffic.tick()
        sent += traffic.sent
    assert len(traffic.status) - n == 100, "every 10 ms"
    assert sum(key == 0x77D for key, _ in sent) == 10


def test_frozen_encoder_counts_as_lost():
    traffic = Traffic().good()
    encoder_frozen(traffic)
    assert traffic.guard.verdict is Verdict.ENCODER


def test_neutral_commands_pass_without_encoders_and_outside_the_range():
    traffic = Traffic()
    traffic.encoder["EncTilt"] = 0
    traffic.good()
    traffic.dropped |= {"EncSlew", "EncLift"}
    assert traffic.tick(60) is Verdict.GOOD


def test_motion_back_into_the_range_passes():
    traffic = Traffic().good()
    outside(traffic)
    traffic.a["Slew"] = -13.0
    assert traffic.tick(10) is Verdict.GOOD


@pytest.mark.parametrize(
    ("growth", "end", "verdict"),
    [
        pytest.param(range(80), {"Mode": 0, "Tilt": 0.0}, Verdict.GOOD, id="slow growth and closing"),
        pytest.param(range(60), {"Tilt": -60.0}, Verdict.RATE, id="a reversal counts as growth"),
    ],
)
def test_a_command_may_grow_slowly_and_close_and_not_jump(growth, end, verdict):
    traffic = Traffic().good()
    for pct in growth:
        traffic.a.update({"Mode": 2, "Tilt": float(pct)})
        assert traffic.tick() is Verdict.GOOD
    traffic.a.update(end)
    assert traffic.tick() is verdict


def test_lasting_fast_growth_is_detected():
    traffic = Traffic().good()
    for pct in range(0, 96, 6):
        traffic.a.update({"Mode": 2, "Tilt": float(pct)})
        traffic.tick()
    assert traffic.guard.verdict is Verdict.RATE


@pytest.mark.parametrize("message", ["ValveCmdA", "ValveCmdB"])
@pytest.mark.parametrize("pattern", ["GB", "GGB", "GGGB", "G" * 30 + "B"])
def test_a_share_of_bad_checksums_breaks_trust(message, pattern):
    """Two bad frames among five, or three among a hundred, whatever lies between; one in fifty is dropped."""
    traffic = Traffic().good()

    def play(letters):
        for letter in letters:
            if letter == "B":
                spoil(traffic, message)
            if traffic.tick() is Verdict.CORRUPT:
                return True
            traffic.dropped.clear()
        return False

    within = len(pattern) * (2 if len(pattern) < 5 else 3)
    assert play((pattern * 100)[:within])
    assert not play_on_a_fresh_guard("G" * 49 + "B", message)


def play_on_a_fresh_guard(pattern, message):
    traffic, broken = Traffic().good(), False
    for letter in pattern * 6:
        if letter == "B":
            spoil(traffic, message)
        broken |= traffic.tick() is not Verdict.GOOD
        traffic.dropped.clear()
    return broken


def test_lost_frames_in_a_row_and_a_second_controller_break_trust():
    traffic = Traffic().good()
    traffic.senders["ValveCmdA"].counter += 3
    assert traffic.tick() is Verdict.STALE
    traffic = Traffic().good()
    other = Sender(DATABASE.message("ValveCmdA").data_ids, counter=traffic.senders["ValveCmdA"].counter + 8)
    codec = DATABASE.message("ValveCmdA")
    for _ in range(60):
        traffic.extra.append(Frame(traffic.now_ns, codec.key, other.protect(codec.encode(0, 0, 0, 0, 0, 0, 0))))
        assert traffic.tick() in (Verdict.STALE, Verdict.NO_COMMAND)


def test_a_frame_that_comes_twice_is_neither_new_nor_a_break():
    traffic = Traffic().good()
    for _ in range(20):
        frame = traffic.frame("ValveCmdA", traffic.a)
        traffic.dropped.add("ValveCmdA")
        traffic.extra += [frame, frame, frame]
        assert traffic.tick() is Verdict.GOOD
    traffic.extra = []
    frame = traffic.frame("ValveCmdA", traffic.a)
    verdicts = set()
    for _ in range(20):
        traffic.extra.append(frame)
        verdicts.add(traffic.tick())
    assert Verdict.NO_COMMAND in verdicts, "a frame that only repeats grows old"


def commands_with_delays(delays_ms, skipped=()):
    """The guard's verdicts while command k, one each 5 ms, arrives ``delays_ms[k]`` late, complete and in order."""
    traffic = Traffic().good()
    traffic.dropped |= {"ValveCmdA", "ValveCmdB"}
    begin_ns, waiting = traffic.now_ns, []
    for k, delay_ms in enumerate(delays_ms):
        if k not in skipped:
            for name, values in (("ValveCmdA", traffic.a), ("ValveCmdB", traffic.b)):
                frame = traffic.frame(name, values)
                waiting.append(frame._replace(stamp_ns=begin_ns + (k + 1) * T + int(delay_ms * MS)))
    verdicts = []
    for _ in delays_ms:
        due_ns = traffic.now_ns + T
        traffic.extra = [frame for frame in waiting if frame.stamp_ns <= due_ns]
        waiting = waiting[len(traffic.extra) :]
        verdicts.append(traffic.tick())
    return verdicts


def test_commands_that_a_transmit_queue_holds_up_are_refused():
    """Complete, in order, with good checksums, never 50 ms apart, and more and more out of date."""
    verdicts = commands_with_delays([2.0 * min(k, 30) for k in range(60)])
    assert Verdict.STALE in verdicts
    arrived = verdicts.index(Verdict.STALE) * 5 // 7  # one every 7 ms
    assert arrived * 2.0 < 50


@pytest.mark.parametrize(
    ("delays_ms", "skipped"),
    [
        pytest.param([0.0005 * k for k in range(4000)], (), marks=pytest.mark.long),
        ([5.0 * (k % 7 == 3) for k in range(400)], ()),
        ([0.0] * 2000, range(100, 2000, 250)),
    ],
    ids=["the controller's quartz is 100 ppm slow", "jitter of a tick", "a tick skipped now and then"],
)
def test_punctual_commands_pass(delays_ms, skipped):
    assert set(commands_with_delays(delays_ms, skipped)[:-3]) == {Verdict.GOOD}


@pytest.mark.parametrize(("rate_hz", "late"), [(100, False), (0, True)])
def test_a_controller_at_another_rate_is_late_unless_the_guard_knows(rate_hz, late):
    """Commands every 10 ms, in order and complete, on a machine whose profile says 5 ms."""
    traffic = Traffic()
    traffic.guard = build(PROFILE, rate_hz=rate_hz)
    traffic.good()
    found = set()
    for k in range(60):
        traffic.dropped = {"ValveCmdA", "ValveCmdB"} if k % 2 else set()
        found.add(traffic.tick())
    assert (Verdict.STALE in found) is late


@pytest.mark.parametrize("key", [0x1FD, 0x77D])
def test_another_guard(key):
    traffic = Traffic().good()
    traffic.extra.append(Frame(traffic.now_ns, key, bytes(8)))
    assert traffic.tick() is Verdict.OTHER_GUARD


@pytest.mark.parametrize(
    ("database", "name"),
    [
        *((DATABASE, name) for name in ("ValveCmdA", "ValveCmdB", "EstopStat", "EncSlew")),
        *((MACHINE, name) for name in ("VehCmd", "ArmCmdA", "ArmCmdB", "VehStat", "GuardAlive")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_own_checksum_and_layout_agree_with_the_codecs(database, name):
    generator, codec, layout = random.Random(1), database.message(name), read_layouts(database.path, [name])[name]
    assert (layout.key, layout.length, layout.data_ids) == (codec.key, codec.length, codec.data_ids or b"")
    assert layout.timeout_ns == codec.timeout_ns
    for _ in range(200):
        data = generator.randbytes(8)
        word = int.from_bytes(data, "little")
        for signal, value in zip(codec.signals, codec.decode(data), strict=True):
            field = layout.fields[signal.name]
            assert field.raw(word) * field.scale == pytest.approx(value)
        if layout.data_ids:
            data_id = codec.data_ids[data[1] & 15]
            assert checksum(data, data_id) == crc8(data[1:] + bytes([data_id]))


@given(st.lists(st.tuples(st.sampled_from([m.key for m in DATABASE.messages.values()]), st.binary(max_size=8))))
@settings(max_examples=100, deadline=None)
def test_random_traffic_never_raises_or_enables(frames):
    guard = build(PROFILE)
    for k in range(5):
        guard.step(10**9 + k * T, [Frame(10**9, key, data) for key, data in frames])
        assert not guard.enabled


def bench_with_guard():
    return Bench(guard=build(PROFILE))


def test_guard_enables_and_stops_the_controller():
    bench = bench_with_guard().armed()
    bench.tick([bench.hold()])
    for k in range(240):
        speed = min(0.03 * (k // 10 + 1), 0.3)
        bench.tick([bench.moving(0, speed)] if k % 10 == 0 else ())
        assert bench.guard.enabled, bench.guard.verdict
    assert bench.mode is Mode.ACTIVE and bench.v[0] > 0.25
    bench.guard.step(bench.now_ns, [Frame(bench.now_ns, 0x1FD, bytes(8))])
    assert bench.run(4) is Mode.FAULT and bench.reason == Reason.GUARD_REFUSES and bench.neutral
    bench.press(OperatorAction.RESET)
    bench.run(100)
    bench.press(OperatorAction.ARM)
    assert not bench.guard.enabled and bench.mode is not Mode.ARMED, "a datagram resets the controller alone"
    bench.changed["EstopStat"] = {"ResetReq": 1}
    bench.run(60)
    bench.changed.clear()
    assert bench.guard.enabled
    assert bench.press(OperatorAction.ARM) is Mode.ARMED


def test_emergency_stop_keeps_its_reason_with_guard_and_controller():
    bench = bench_with_guard().active()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    bench.run(4)
    assert bench.reason == Reason.ESTOP_PRESSED and not bench.guard.enabled


def test_configuration_errors_have_codes_and_exit_codes(tmp_path, capsys):
    with pytest.raises(GuardConfigError, check=coded("guard.profile-unreadable")):
        read_envelope(tmp_path / "none.toml")
    (tmp_path / "half.toml").write_text("[joints.slew]\nlower = 0\n")
    with pytest.raises(GuardConfigError, check=coded("guard.profile-incomplete")):
        read_envelope(tmp_path / "half.toml")
    with pytest.raises(GuardConfigError, check=coded("guard.message-missing")):
        read_layouts(DATABASE.path, ["NoSuchMessage"])
    assert main(["--profile", str(tmp_path / "none.toml"), "--bus", "crane0=wire:nowhere"]) == 3
    assert main(["--profile", "palms_471", "--bus", "crane0=wire:nowhere"]) == 4
    assert capsys.readouterr().err.count("guard: ") == 2


def test_the_guard_tells_how_near_its_joints_come_to_a_fault():
    traffic = Traffic()
    assert not any(watch.share() for _, watch in traffic.guard.motion), "nothing is known yet"
    traffic.tick(60)
    shares = [joint.share() for joint in traffic.guard.joints.values()]
    assert shares and max(shares + [watch.share() for _, watch in traffic.guard.motion]) < 0.5


def test_what_judges_has_at_most_650_lines_of_code():
    """Without blank lines, comments and docstrings, so that explaining a rule costs nothing.

    Apart from what runs once, at the start (reading the files, and the process around the loop), and what
    brings frames and a person's commands, and keeps the latch.
    """
    folder = Path(__file__).parents[2] / "controller" / "guard"
    start, carries = {"__init__", "__main__", "envelope", "layout", "seal"}, {"can_socket", "latch_file", "operator"}
    code = dict.fromkeys(("judges", "starts", "carries"), 0)
    for path in folder.glob("*.py"):
        tree = ast.parse(path.read_text())
        prose = [n for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
        explained = {k for n in prose for k in range(n.lineno, (n.end_lineno or n.lineno) + 1)}
        lines = enumerate(path.read_text().splitlines(), 1)
        part = "starts" if path.stem in start else "carries" if path.stem in carries else "judges"
        code[part] += sum(k not in explained and bool(t := line.strip()) and t[0] != "#" for k, line in lines)
    assert code["judges"] <= 650 and code["starts"] <= 365 and code["carries"] <= 230, code
    assert Guard.__slots__


@pytest.mark.parametrize("mode", [1, 2])
def test_opening_or_closing_grapple_is_not_neutral(mode):
    """The grapple moves by its mode alone, so the mode must be armed like any other motion."""
    traffic = Traffic()
    assert traffic.tick(60) is Verdict.GOOD
    traffic.b = {"ArmKey": 0, "GrappleMode": mode}
    assert traffic.tick(2) is Verdict.NOT_ARMED


def test_held_grapple_is_neutral():
    traffic = Traffic()
    traffic.b = {"ArmKey": 0, "GrappleMode": 3}
    assert traffic.tick(60) is Verdict.GOOD
