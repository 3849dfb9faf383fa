"""Traffic on the buses for tests of the guard alone, and a way to break each of its rules."""

from can_dbc.frame import Frame
from can_dbc.messages.crane import OperatorAction
from can_dbc.protocols.e2e import Sender
from controller.guard.__main__ import build, profile_path
from controller.guard.verdicts import Verdict
from tests.controller.bench import CODECS, T

PROFILE = profile_path("palms_471")
CENTRE = 8192
HOME = {
    "palms_471": {"EncSlew": CENTRE, "EncLift": CENTRE, "EncTilt": CENTRE, "EncExt": 100_000, "EncRot": CENTRE},
    "aoro_fc8": {"EncSlew": 131072, "EncLift": 131072, "EncTilt": 131072 - 41_722, "EncExt": 100_000},
}
GOOD_A = {"Mode": 0}
GOOD_B = {"ArmKey": 0xA}
MOVING = {"Mode": 2, "Slew": 13.0}
STANDING = {"Brake": 100.0}
BOTH_FLOAT = {"FloatFront": 1, "FloatRear": 1}
DRIVING = {"ArmKey": 0xA, "Speed": 0.01, "Brake": 0.0}


class Traffic:
    """Frames on the buses of a machine, for the guard alone; mach0 where the machine has one, every fourth tick."""

    def __init__(self, machine="palms_471") -> None:
        self.guard = build(profile_path(machine))
        self.now_ns = 10**9
        self.senders = {n: Sender(m.data_ids) for n, m in CODECS.items() if m.data_ids}
        self.a, self.b, self.estop = dict(GOOD_A), dict(GOOD_B), {"ChannelA": 1, "ChannelB": 1}
        self.controller, self.valve_a, self.valve_b = {"Mode": 3}, {}, {}
        self.drive, self.arms_a, self.arms_b, self.vehicle = dict(STANDING), {}, {}, {"Brake": 1}
        self.encoder = dict(HOME[machine])
        self.has_carrier = machine == "aoro_fc8"
        self.dropped: set[str] = set()
        self.extra: list[Frame] = []
        self.stamp = self.ticks = 0
        self.status: list[dict] = []
        self.alive: list[dict] = []
        self.pilot: list[dict] = []
        self.sent: list[tuple[int, bytes]] = []

    def frame(self, name, values):
        codec = CODECS[name]
        data = codec.encode(*(values.get(s.name, 0) for s in codec.signals))
        return Frame(self.now_ns, codec.key, self.senders[name].protect(data) if codec.data_ids else data)

    def tick(self, n=1):
        for _ in range(n):
            self.now_ns += T
            self.stamp = (self.stamp + 5000) & 0xFFFF
            wanted = {"ValveCmdA": self.a, "ValveCmdB": self.b, "EstopStat": self.estop, "CtrlStatus": self.controller}
            wanted |= {"ValveFbA": self.valve_a, "ValveFbB": self.valve_b}
            if self.has_carrier and self.ticks % 4 == 0:
                wanted |= {"VehCmd": self.drive, "ArmCmdA": self.arms_a, "ArmCmdB": self.arms_b}
                wanted["VehStat"] = self.vehicle
            self.ticks += 1
            wanted |= {e: {"Position": p, "TimeStamp": self.stamp} for e, p in self.encoder.items()}
            frames = [self.frame(n, v) for n, v in wanted.items() if n not in self.dropped]
            self.sent = self.guard.step(self.now_ns, frames + self.extra)
            self.extra = []
            for name, seen in (("GuardStat", self.status), ("GuardAlive", self.alive), ("GuardPilot", self.pilot)):
                codec = CODECS[name]
                seen += [codec.named(codec.receive(data)) for key, data in self.sent if key == codec.key]
        return self.guard.verdict

    def good(self):
        self.tick(60)
        assert self.guard.verdict is Verdict.GOOD, self.guard.verdict
        return self.press()

    def press(self, action=OperatorAction.ARM):
        """A person presses a button, and the guard hears it."""
        self.guard.hear(action, self.now_ns)
        return self


def spoil(traffic, message):
    """The next frame of a message has a wrong checksum."""
    traffic.dropped.add(message)
    frame = traffic.frame(message, traffic.a if message == "ValveCmdA" else traffic.b)
    traffic.extra.append(Frame(frame.stamp_ns, frame.key, bytes([frame.data[0] ^ 1]) + frame.data[1:]))


def press_reset(traffic, ticks=4):
    traffic.estop["ResetReq"] = 1
    traffic.tick(ticks)
    traffic.estop["ResetReq"] = 0
    return traffic.tick()


def change(**fields):
    def apply(traffic):
        for name, value in fields.items():
            getattr(traffic, name).update(value)

    return apply


def gone(message, **fields):
    """A message stays away, while other fields change."""

    def apply(traffic):
        traffic.dropped.add(message)
        change(**fields)(traffic)

    return apply


def encoder_frozen(traffic):
    traffic.a.update(MOVING)
    traffic.tick(1)
    traffic.dropped.add("EncTilt")
    codec = CODECS["EncTilt"]
    for _ in range(25):
        traffic.extra.append(Frame(traffic.now_ns, codec.key, codec.encode(CENTRE, 7, 0)))
        traffic.tick(1)


def put(traffic, **counts):
    """Joints are somewhere else when their encoders are heard again: nothing has seen them move."""
    traffic.dropped |= counts.keys()
    traffic.tick(20)
    traffic.encoder.update(counts)
    traffic.dropped -= counts.keys()
    traffic.tick()


def outside(traffic):
    put(traffic, EncSlew=CENTRE + int(1.76 / 3.835e-4))
    traffic.a.update(MOVING)


def under_ground(traffic):
    """The boom 45 deg down (its own range is checked apart), and lowered further."""
    put(traffic, EncLift=CENTRE - int(0.38 / 3.835e-4), EncTilt=CENTRE - int(0.60 / 3.835e-4))
    traffic.a.update({"Mode": 2, "Lift": -13.0})


def hurries(traffic):
    """A joint that is commanded is suddenly further than it can be."""
    traffic.a.update(MOVING)
    traffic.encoder["EncSlew"] += int(0.02 / 3.835e-4)


def displaced(traffic):
    """A joint moves away, slowly, while every command is neutral."""
    traffic.tick(100)
    traffic.encoder["EncTilt"] += int(0.03 / 3.835e-4)


# what is broken: verdict, axis, steps of 5 ms until it counts, and how
BROKEN = {
    "command A gone": (Verdict.NO_COMMAND, 15, 4, gone("ValveCmdA")),
    "command B gone": (Verdict.NO_COMMAND, 15, 4, gone("ValveCmdB")),
    "not armed": (Verdict.NOT_ARMED, 15, 1, change(a=MOVING, b={"ArmKey": 0})),
    "rotator not armed": (Verdict.NOT_ARMED, 15, 1, change(b={"Rot": 11.0, "ArmKey": 0})),
    "grapple not armed": (Verdict.NOT_ARMED, 15, 1, change(b={"Grapple": 100.0, "ArmKey": 0})),
    "nearly armed": (Verdict.NOT_ARMED, 15, 1, change(a=MOVING, b={"ArmKey": 0xB})),
    "unknown mode": (Verdict.RANGE, 15, 1, change(a={"Mode": 1})),
    "auxiliary": (Verdict.RANGE, 6, 1, change(b={"Aux": 1.0})),
    "value not available": (Verdict.RANGE, 1, 1, change(a={"Mode": 2, "Lift": None})),
    "grapple not available": (Verdict.RANGE, 5, 1, change(b={"Grapple": None})),
    "too fast a change": (Verdict.RATE, 2, 1, change(a={"Mode": 2, "Tilt": 80.0})),
    "estop pressed": (Verdict.ESTOP, 15, 1, change(estop={"ChannelA": 0, "ChannelB": 0})),
    "estop channel in error": (Verdict.ESTOP, 15, 1, change(estop={"ChannelB": 2})),
    "estop gone": (Verdict.ESTOP_LOST, 15, 7, gone("EstopStat")),
    "encoder gone": (Verdict.ENCODER, 2, 19, gone("EncTilt", a=MOVING)),
    "outside": (Verdict.OUTSIDE, 0, 2, outside),
    "too fast a motion": (Verdict.OVERSPEED, 0, 3, hurries),
    "spool open without a command": (Verdict.SPOOL, 3, 1, change(valve_a={"SpoolExt": -20.0})),
    "grapple opens without a command": (Verdict.SPOOL, 5, 1, change(valve_b={"SpoolGrapple": 30.0})),
    "joint moves without a command": (Verdict.MOVING, 2, 3, displaced),
    "person in the zone": (Verdict.PERSON, 15, 61, change(a=MOVING, estop={"Person": 1})),
    "failed detector of persons": (Verdict.PERSON, 15, 61, change(a=MOVING, estop={"Person": 2})),
    "pin into the ground": (Verdict.REACH, 15, 2, under_ground),
    "controller says it has stopped": (Verdict.DISAGREE, 15, 41, change(a=MOVING, controller={"Mode": 4})),
    "controller says nothing": (Verdict.DISAGREE, 15, 61, gone("CtrlStatus", a=MOVING)),
}
DRIVE_BROKEN = {
    "drive command gone": (Verdict.NO_COMMAND, 15, 16, gone("VehCmd")),
    "arm command gone": (Verdict.NO_COMMAND, 15, 16, gone("ArmCmdB")),
    "driving not armed": (Verdict.NOT_ARMED, 7, 1, change(drive=DRIVING | {"ArmKey": 0})),
    "steering not armed": (Verdict.NOT_ARMED, 7, 1, change(drive={"ArticRate": 0.1})),
    "brake released not armed": (Verdict.NOT_ARMED, 7, 1, change(drive={"Brake": 0.0})),
    "arm not armed": (Verdict.NOT_ARMED, 9, 1, change(arms_a={"Arm3": 5.0}, arms_b={"ArmKey": 0xA})),
    "float valve not armed": (Verdict.NOT_ARMED, 9, 1, change(arms_b={"FloatRear": 1})),
    "both float valves": (Verdict.RANGE, 9, 1, change(arms_a=GOOD_B, arms_b=GOOD_B | BOTH_FLOAT)),
    "arm not available": (Verdict.RANGE, 9, 1, change(arms_a={"ArmKey": 0xA, "Arm1": None})),
    "too fast": (Verdict.RANGE, 7, 1, change(drive=DRIVING | {"Speed": -1.1})),
    "speed not available": (Verdict.RANGE, 7, 1, change(drive=DRIVING | {"Speed": None})),
    "brake not available": (Verdict.RANGE, 7, 1, change(drive=DRIVING | {"Brake": None})),
    "steering too fast": (Verdict.RANGE, 8, 1, change(drive=DRIVING | {"ArticRate": 0.22})),
    "speed jumps": (Verdict.RATE, 7, 1, change(drive=DRIVING | {"Speed": 0.3})),
    "bent further out": (
        Verdict.OUTSIDE,
        8,
        1,
        change(drive=DRIVING | {"ArticRate": -0.1}, vehicle={"Articulation": -0.7}),
    ),
    "state gone": (Verdict.CARRIER_LOST, 7, 18, gone("VehStat", drive=DRIVING)),
    "state not available": (Verdict.CARRIER_LOST, 7, 1, change(drive=DRIVING, vehicle={"Articulation": None})),
    "rolls although it brakes": (Verdict.MOVING, 7, 301, change(vehicle={"Speed": -0.2})),
    "crane while it drives": (Verdict.BOTH, 7, 51, lambda t: drive_and_slew(t)),
    "person while it drives": (Verdict.PERSON, 7, 441, change(drive=DRIVING, estop={"Person": 1})),
    "other guard on mach0": (
        Verdict.OTHER_GUARD,
        15,
        1,
        lambda t: t.extra.append(Frame(t.now_ns, CODECS["GuardAlive"].key, bytes(8))),
    ),
}


def drive_and_slew(traffic):
    """Both at once, each grown as slowly as it may."""
    traffic.drive.update(DRIVING)
    traffic.a["Mode"] = 2
    for k in range(50):
        traffic.drive["Speed"] = min(0.2, 0.005 * k)
        traffic.a["Slew"] = min(50.0, float(k))
        traffic.tick(2)
        assert traffic.guard.enabled, traffic.guard.verdict
        if traffic.a["Slew"] > 42.0:
            return
