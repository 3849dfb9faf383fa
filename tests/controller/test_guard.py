"""The guard alone, rule by rule, and together with the controller on the bench."""

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.e2e import Sender, crc8
from controller.guard.__main__ import build, main, profile_path
from controller.guard.envelope import read_envelope
from controller.guard.guard import CALM_NS, Guard, Verdict, checksum
from controller.guard.layout import GuardConfigError, read_layouts
from machine.status.modes import Mode
from machine.status.reasons import Reason
from tests.codes import coded
from tests.controller.bench import DATABASE, MS, Bench, T, count_until

PROFILE = profile_path("palms_471")
CENTRE = 8192
GOOD_A = {"Mode": 0}
GOOD_B = {"ArmKey": 0xA}
MOVING = {"Mode": 2, "Slew": 13.0}


class Traffic:
    """Frames on a bus, for the guard alone."""

    def __init__(self) -> None:
        self.guard = build(PROFILE)
        self.now_ns = 10**9
        self.senders = {n: Sender(m.data_ids) for n, m in DATABASE.messages.items() if m.data_ids}
        self.a, self.b, self.estop = dict(GOOD_A), dict(GOOD_B), {"ChannelA": 1, "ChannelB": 1}
        self.encoder = {"EncSlew": CENTRE, "EncLift": CENTRE, "EncTilt": CENTRE, "EncExt": 100_000, "EncRot": CENTRE}
        self.dropped: set[str] = set()
        self.extra: list[Frame] = []
        self.stamp = 0
        self.status: list[dict] = []
        self.sent: list[tuple[int, bytes]] = []

    def frame(self, name, values):
        codec = DATABASE.message(name)
        data = codec.encode(*(values.get(s.name, 0) for s in codec.signals))
        return Frame(self.now_ns, codec.key, self.senders[name].protect(data) if codec.data_ids else data)

    def tick(self, n=1):
        for _ in range(n):
            self.now_ns += T
            self.stamp = (self.stamp + 5000) & 0xFFFF
            wanted = {"ValveCmdA": self.a, "ValveCmdB": self.b, "EstopStat": self.estop}
            wanted |= {e: {"Position": p, "TimeStamp": self.stamp} for e, p in self.encoder.items()}
            frames = [self.frame(n, v) for n, v in wanted.items() if n not in self.dropped]
            self.sent = self.guard.step(self.now_ns, frames + self.extra)
            self.extra = []
            for key, data in self.sent:
                if key == 0x1FD:
                    codec = DATABASE.message("GuardStat")
                    self.status.append(codec.named(codec.receive(data)))
        return self.guard.verdict

    def good(self):
        self.tick(60)
        assert self.guard.verdict is Verdict.GOOD
        return self


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
    assert traffic.status[-1]["SeenCounter"] == (traffic.senders["ValveCmdA"].counter - 1) % 16


def test_first_heartbeat_is_the_boot_up_frame():
    traffic = Traffic()
    traffic.tick()
    assert (0x77D, b"\x00") in traffic.sent
    traffic.tick(20)
    assert (0x77D, b"\x05") in traffic.sent


def change(**fields):
    def apply(traffic):
        for name, value in fields.items():
            getattr(traffic, name).update(value)

    return apply


def encoder_gone(traffic):
    traffic.a.update(MOVING)
    traffic.dropped.add("EncTilt")


def encoder_frozen(traffic):
    traffic.a.update(MOVING)
    traffic.tick(1)
    traffic.dropped.add("EncTilt")
    codec = DATABASE.message("EncTilt")
    for _ in range(25):
        traffic.extra.append(Frame(traffic.now_ns, codec.key, codec.encode(CENTRE, 7, 0)))
        traffic.tick(1)


def outside(traffic):
    traffic.encoder["EncSlew"] = CENTRE + int(1.85 / 3.835e-4)
    traffic.a.update(MOVING)


BROKEN = {
    "command A gone": (Verdict.NO_COMMAND, 15, 60, lambda t: t.dropped.add("ValveCmdA")),
    "command B gone": (Verdict.NO_COMMAND, 15, 60, lambda t: t.dropped.add("ValveCmdB")),
    "not armed": (Verdict.NOT_ARMED, 15, 10, change(a=MOVING, b={"ArmKey": 0})),
    "rotator not armed": (Verdict.NOT_ARMED, 15, 10, change(b={"Rot": 11.0, "ArmKey": 0})),
    "grapple not armed": (Verdict.NOT_ARMED, 15, 10, change(b={"Grapple": 100.0, "ArmKey": 0})),
    "nearly armed": (Verdict.NOT_ARMED, 15, 10, change(a=MOVING, b={"ArmKey": 0xB})),
    "unknown mode": (Verdict.RANGE, 15, 10, change(a={"Mode": 1})),
    "auxiliary": (Verdict.RANGE, 6, 10, change(b={"Aux": 1.0})),
    "value not available": (Verdict.RANGE, 1, 10, change(a={"Mode": 2, "Lift": None})),
    "grapple not available": (Verdict.RANGE, 5, 10, change(b={"Grapple": None})),
    "too fast a change": (Verdict.RATE, 2, 10, change(a={"Mode": 2, "Tilt": 80.0})),
    "estop pressed": (Verdict.ESTOP, 15, 10, change(estop={"ChannelA": 0, "ChannelB": 0})),
    "estop channel in error": (Verdict.ESTOP, 15, 10, change(estop={"ChannelB": 2})),
    "estop gone": (Verdict.ESTOP, 15, 40, lambda t: t.dropped.add("EstopStat")),
    "encoder gone": (Verdict.ENCODER, 2, 100, encoder_gone),
    "outside": (Verdict.OUTSIDE, 0, 10, outside),
}


@pytest.mark.parametrize("name", BROKEN)
def test_each_rule(name):
    verdict, axis, bound_ms, break_it = BROKEN[name]
    traffic = Traffic().good()
    events = traffic.guard.events
    break_it(traffic)
    k = count_until(traffic.tick, lambda: traffic.guard.verdict is not Verdict.GOOD)
    assert (traffic.guard.verdict, traffic.guard.axis) == (verdict, axis)
    assert k * T <= bound_ms * MS
    status = traffic.status[-1]
    assert (status["Enable"], status["Verdict"], status["FaultAxis"]) == (0, verdict, axis)
    assert any(key == 0x1FD for key, _ in traffic.sent), "sent at once"
    assert traffic.guard.events == events + 1


def test_frozen_encoder_counts_as_lost():
    traffic = Traffic().good()
    encoder_frozen(traffic)
    assert traffic.guard.verdict is Verdict.ENCODER


def test_neutral_commands_pass_without_encoders_and_outside_the_range():
    traffic = Traffic().good()
    traffic.dropped |= {"EncSlew", "EncLift"}
    assert traffic.tick(60) is Verdict.GOOD
    traffic.encoder["EncTilt"] = 0
    traffic.a.update({"Mode": 0})
    assert traffic.tick(10) is Verdict.GOOD


def test_motion_back_into_the_range_passes():
    traffic = Traffic().good()
    outside(traffic)
    traffic.a["Slew"] = -13.0
    assert traffic.tick(10) is Verdict.GOOD


def test_slow_growth_and_closing_pass():
    traffic = Traffic().good()
    for pct in range(80):
        traffic.a.update({"Mode": 2, "Tilt": float(pct)})
        assert traffic.tick() is Verdict.GOOD
    traffic.a.update({"Mode": 0, "Tilt": 0.0})
    assert traffic.tick() is Verdict.GOOD


def test_lasting_fast_growth_is_detected():
    traffic = Traffic().good()
    for pct in range(0, 96, 6):
        traffic.a.update({"Mode": 2, "Tilt": float(pct)})
        traffic.tick()
    assert traffic.guard.verdict is Verdict.RATE


def test_reversal_counts_as_growth():
    traffic = Traffic().good()
    for pct in range(60):
        traffic.a.update({"Mode": 2, "Tilt": float(pct)})
        traffic.tick()
    traffic.a["Tilt"] = -60.0
    assert traffic.tick() is Verdict.RATE


@pytest.mark.parametrize("times", [1, 2])
def test_one_bad_checksum_is_dropped_two_break_trust(times):
    traffic = Traffic().good()
    for _ in range(times):
        traffic.dropped.add("ValveCmdA")
        frame = traffic.frame("ValveCmdA", traffic.a)
        traffic.extra.append(Frame(frame.stamp_ns, frame.key, bytes([frame.data[0] ^ 1]) + frame.data[1:]))
        traffic.tick()
        traffic.dropped.clear()
    assert traffic.guard.verdict is (Verdict.GOOD if times == 1 else Verdict.CORRUPT)


def test_lost_frames_in_a_row_and_a_second_controller_break_trust():
    traffic = Traffic().good()
    traffic.senders["ValveCmdA"].counter += 3
    assert traffic.tick() is Verdict.CORRUPT
    traffic = Traffic().good()
    other = Sender(DATABASE.message("ValveCmdA").data_ids, counter=traffic.senders["ValveCmdA"].counter + 8)
    codec = DATABASE.message("ValveCmdA")
    traffic.extra.append(Frame(traffic.now_ns, codec.key, other.protect(codec.encode(0, 0, 0, 0, 0, 0, 0))))
    assert traffic.tick() is Verdict.CORRUPT


@pytest.mark.parametrize("key", [0x1FD, 0x77D])
def test_another_guard(key):
    traffic = Traffic().good()
    traffic.extra.append(Frame(traffic.now_ns, key, bytes(8)))
    assert traffic.tick() is Verdict.OTHER_GUARD


def test_enable_returns_after_200_ms_of_neutral_commands():
    traffic = Traffic().good()
    traffic.a.update(MOVING)
    traffic.estop["ChannelA"] = 0
    traffic.tick()
    traffic.estop["ChannelA"] = 1
    assert traffic.tick(100) is Verdict.CALMING, "still commanding"
    traffic.a.update({"Mode": 0, "Slew": 0.0})
    k = count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.GOOD)
    assert abs(k * T - CALM_NS) <= 2 * T


def test_own_checksum_and_layout_agree_with_the_codecs():
    generator = random.Random(1)
    for name in ("ValveCmdA", "ValveCmdB", "EstopStat"):
        codec = DATABASE.message(name)
        layout = read_layouts(DATABASE.path, [name])[name]
        assert (layout.key, layout.length, layout.data_ids) == (codec.key, codec.length, codec.data_ids)
        assert layout.timeout_ns == codec.timeout_ns
        for _ in range(300):
            data = generator.randbytes(8)
            word = int.from_bytes(data, "little")
            for signal, value in zip(codec.signals, codec.decode(data), strict=True):
                field = layout.fields[signal.name]
                assert field.raw(word) * field.scale == pytest.approx(value)
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
    bench.run(4)
    assert bench.mode is Mode.FAULT and bench.reason == Reason.GUARD_REFUSES and bench.neutral
    bench.run(60)
    assert bench.guard.enabled
    bench.tick([bench.operator(OperatorAction.RESET)])
    bench.tick([bench.operator(OperatorAction.ARM)])
    assert bench.mode is Mode.ARMED


def test_emergency_stop_keeps_its_reason_with_guard_and_controller():
    bench = bench_with_guard().active()
    bench.changed["EstopStat"] = {"ChannelA": 0, "ChannelB": 0}
    bench.run(4)
    assert bench.reason == Reason.ESTOP_PRESSED and not bench.guard.enabled


def test_guard_stops_a_controller_that_ignores_a_lost_encoder():
    traffic = Traffic().good()
    encoder_gone(traffic)
    assert traffic.tick(16) is Verdict.GOOD, "the controller has time to react first"
    assert traffic.tick(4) is Verdict.ENCODER


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


def test_guard_imports_nothing_but_the_standard_library():
    import subprocess
    import sys

    code = (
        "import sys, controller.guard.__main__; bad = [m for m in sys.modules if m.split('.')[0] in "
        "('can','cantools','canopen','msgspec','numpy','machine') or m in ('can_dbc.dbc.codec','controller.step')]; "
        "print(bad)"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_guard_has_at_most_600_lines():
    folder = Path(__file__).parents[2] / "controller" / "guard"
    assert sum(len(p.read_text().splitlines()) for p in folder.glob("*.py")) <= 600
    assert Guard.__slots__


@pytest.mark.parametrize("mode", [1, 2])
def test_opening_or_closing_grapple_is_not_neutral(mode):
    """The grapple moves by its mode alone, so the mode must be armed like any other motion."""
    traffic = Traffic()
    traffic.tick(60)
    assert traffic.guard.verdict is Verdict.GOOD
    traffic.b = {"ArmKey": 0, "GrappleMode": mode}
    traffic.tick(2)
    assert traffic.guard.verdict is Verdict.NOT_ARMED


def test_held_grapple_is_neutral():
    traffic = Traffic()
    traffic.b = {"ArmKey": 0, "GrappleMode": 3}
    traffic.tick(60)
    assert traffic.guard.verdict is Verdict.GOOD
