"""Traffic on a bus for tests of the guard alone, and a way to break each of its rules."""

from can_dbc.frame import Frame
from can_dbc.protocols.e2e import Sender
from controller.guard.__main__ import build, profile_path
from controller.guard.guard import Verdict
from tests.controller.bench import DATABASE, T

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
