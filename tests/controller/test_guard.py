"""The guard alone, rule by rule, and together with the controller on the bench."""

import ast
import random
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.e2e import Sender, crc8
from controller.guard.__main__ import build, main, profile_path
from controller.guard.envelope import read_envelope
from controller.guard.guard import CALM_NS, LATCHING, Guard, Verdict, checksum
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
    "estop gone": (Verdict.ESTOP_LOST, 15, 40, lambda t: t.dropped.add("EstopStat")),
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


def spoil(traffic, message):
    """The next frame of a message has a wrong checksum."""
    traffic.dropped.add(message)
    frame = traffic.frame(message, traffic.a if message == "ValveCmdA" else traffic.b)
    traffic.extra.append(Frame(frame.stamp_ns, frame.key, bytes([frame.data[0] ^ 1]) + frame.data[1:]))


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
        ([0.0005 * k for k in range(4000)], ()),
        ([5.0 * (k % 7 == 3) for k in range(400)], ()),
        ([0.0] * 2000, range(100, 2000, 250)),
    ],
    ids=["the controller's quartz is 100 ppm slow", "jitter of a tick", "a tick skipped now and then"],
)
def test_punctual_commands_pass(delays_ms, skipped):
    assert set(commands_with_delays(delays_ms, skipped)[:-3]) == {Verdict.GOOD}


@pytest.mark.parametrize("key", [0x1FD, 0x77D])
def test_another_guard(key):
    traffic = Traffic().good()
    traffic.extra.append(Frame(traffic.now_ns, key, bytes(8)))
    assert traffic.tick() is Verdict.OTHER_GUARD


def press_reset(traffic, ticks=4):
    traffic.estop["ResetReq"] = 1
    traffic.tick(ticks)
    traffic.estop["ResetReq"] = 0
    return traffic.tick()


def test_enable_returns_after_a_silence_and_200_ms_of_neutral_commands():
    traffic = Traffic().good()
    traffic.dropped.add("ValveCmdB")
    traffic.tick(20)
    traffic.dropped.clear()
    traffic.a.update(MOVING)
    assert traffic.tick(100) is Verdict.CALMING, "still commanding"
    traffic.a.update({"Mode": 0, "Slew": 0.0})
    k = count_until(traffic.tick, lambda: traffic.guard.verdict is Verdict.GOOD)
    assert abs(k * T - CALM_NS) <= 2 * T


def other_guard(traffic):
    traffic.extra.append(Frame(traffic.now_ns, 0x1FD, bytes(8)))


def corrupt(traffic):
    for _ in range(2):
        spoil(traffic, "ValveCmdA")


LATCHED = {name: case for name, case in BROKEN.items() if case[0] in LATCHING}
LATCHED |= {
    "other guard": (Verdict.OTHER_GUARD, 15, 10, other_guard),
    "corrupt": (Verdict.CORRUPT, 15, 10, corrupt),
}


def test_every_rule_that_latches_is_tried():
    assert {case[0] for case in LATCHED.values()} == LATCHING


@pytest.mark.parametrize("name", LATCHED)
def test_it_never_enables_again_by_itself(name):
    """The cause is gone and all commands are neutral; only the button of the safety module lets it enable again."""
    traffic = Traffic().good()
    a, b, estop, encoder = dict(traffic.a), dict(traffic.b), dict(traffic.estop), dict(traffic.encoder)
    LATCHED[name][3](traffic)
    traffic.tick(5)
    assert not traffic.guard.enabled
    press_reset(traffic)
    pressed_too_early = traffic.guard.verdict
    traffic.a, traffic.b, traffic.estop, traffic.encoder = a, b, estop, encoder
    traffic.dropped.clear()
    if name not in ("other guard", "corrupt"):  # these two are over at once
        assert pressed_too_early is not Verdict.CALMING
        assert traffic.tick(2000) is Verdict.LATCHED
    traffic.tick(10)
    press_reset(traffic)
    assert count_until(traffic.tick, lambda: traffic.guard.enabled) * T <= CALM_NS + 2 * T


def test_a_button_that_is_held_a_moving_command_and_a_lost_module_give_no_reset():
    traffic = Traffic().good()
    traffic.estop["ResetReq"] = 1
    traffic.tick(5)
    traffic.estop["ChannelA"] = 0
    traffic.tick(5)
    traffic.estop["ChannelA"] = 1
    assert traffic.tick(100) is Verdict.LATCHED, "held since before"
    traffic.dropped.add("EstopStat")
    traffic.tick(20)
    traffic.dropped.clear()
    assert traffic.tick(100) is Verdict.LATCHED, "the module was away, and its button is still down"
    traffic.estop["ResetReq"] = 0
    traffic.a.update(MOVING)
    assert press_reset(traffic) is Verdict.LATCHED, "a motion is commanded"
    traffic.a = dict(GOOD_A)
    assert press_reset(traffic) is Verdict.CALMING
    assert traffic.tick(60) is Verdict.GOOD


values = st.sampled_from([-100.0, -13.0, 0.0, 13.0, 100.0, None])
lies = st.fixed_dictionaries(
    {
        "a": st.fixed_dictionaries(
            {"Mode": st.integers(0, 3)} | dict.fromkeys(("Slew", "Lift", "Tilt", "Ext"), values)
        ),
        "b": st.fixed_dictionaries(
            {
                "ArmKey": st.sampled_from([0, 0xA, 0xB]), "Rot": values, "Grapple": values, "Aux": values,
                "GrappleMode": st.integers(0, 3), "MaxFlow": st.sampled_from([0.0, 100.0]),
            }
        ),
        "ticks": st.integers(1, 70),
        "channels": st.sampled_from([(1, 1)] * 6 + [(0, 0), (1, 0), (2, 1)]),
        "reset": st.booleans(),
        "slew_counts": st.sampled_from([CENTRE] * 3 + [CENTRE - 5200, CENTRE + 5200]),
        "gone": st.sampled_from([set()] * 5 + [{"EncLift"}, {"EstopStat"}, {"ValveCmdA"}]),
        "skip": st.sampled_from([0, 0, 0, 1, 2, 7]),
    }
)  # fmt: skip
NEUTRAL_LIE = {"a": dict(GOOD_A), "b": dict(GOOD_B), "ticks": 60, "channels": (1, 1), "reset": False,
               "slew_counts": CENTRE, "gone": set(), "skip": 0}  # fmt: skip


@given(st.lists(st.one_of(lies, st.just(NEUTRAL_LIE)), max_size=12))
@example([NEUTRAL_LIE, NEUTRAL_LIE | {"channels": (0, 0)}, NEUTRAL_LIE, NEUTRAL_LIE])
@settings(max_examples=150, deadline=None)
def test_a_controller_that_lies_in_every_field_moves_nothing_outside_the_promise(episodes):
    """What the valve node would do is judged from the sent values alone, by rules written here."""
    traffic, stopped, before, since_encoder = Traffic(), False, True, 0
    for lie in episodes:
        traffic.a, traffic.b = dict(lie["a"]), dict(lie["b"])
        a, b = lie["channels"]
        traffic.estop = {"ChannelA": a, "ChannelB": b, "ResetReq": int(lie["reset"])}
        traffic.encoder["EncSlew"] = lie["slew_counts"]
        traffic.dropped = set(lie["gone"])
        traffic.senders["ValveCmdA"].counter += lie["skip"]
        for k in range(lie["ticks"]):
            traffic.tick()
            seen = "EstopStat" not in traffic.dropped
            stopped |= seen and (a, b) != (1, 1) and k >= 3
            if seen and lie["reset"] and not before and (a, b) == (1, 1):
                stopped = False
            before = lie["reset"] if seen else True
            since_encoder = since_encoder + 1 if "EncLift" in traffic.dropped else 0
            if not traffic.guard.enabled or k < 3:
                continue
            assert not stopped, "the emergency stop was pressed, and nobody has reset it since"
            assert (a, b) == (1, 1) or not seen
            functions = {
                **{n: lie["a"].get(n) or 0.0 for n in ("Slew", "Lift", "Tilt", "Ext")},
                "Rot": lie["b"].get("Rot"),
            }
            spools = {n: v for n, v in functions.items() if v} if lie["a"]["Mode"] == 2 else {}
            if "ValveCmdA" in traffic.dropped or lie["skip"] > 1:
                continue  # the node has no such command
            assert not lie["b"].get("Aux") and None not in {**lie["a"], **lie["b"]}.values()
            moves = spools or lie["b"].get("GrappleMode") in (1, 2)
            assert not moves or lie["b"]["ArmKey"] == 0xA
            assert not spools or since_encoder * T <= 100 * MS
            side = (lie["slew_counts"] > CENTRE) - (lie["slew_counts"] < CENTRE)
            assert side * spools.get("Slew", 0.0) <= 0.0, "driven further out"


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
    bench.tick([bench.operator(OperatorAction.RESET)])
    bench.run(100)
    bench.tick([bench.operator(OperatorAction.ARM)])
    assert not bench.guard.enabled and bench.mode is not Mode.ARMED, "a datagram resets the controller alone"
    bench.changed["EstopStat"] = {"ResetReq": 1}
    bench.run(60)
    bench.changed.clear()
    assert bench.guard.enabled
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


def test_guard_has_at_most_500_lines_of_code():
    """Without blank lines, comments and docstrings, so that explaining a rule costs nothing."""
    folder = Path(__file__).parents[2] / "controller" / "guard"
    code = 0
    for path in folder.glob("*.py"):
        tree = ast.parse(path.read_text())
        prose = [n for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
        explained = {k for n in prose for k in range(n.lineno, (n.end_lineno or n.lineno) + 1)}
        lines = enumerate(path.read_text().splitlines(), 1)
        code += sum(k not in explained and bool(t := line.strip()) and t[0] != "#" for k, line in lines)
    assert code <= 500
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
