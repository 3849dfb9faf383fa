"""The guard's carrier with its messages on mach0, as a test wants them."""

from __future__ import annotations

from can_dbc.frame import Frame
from can_dbc.protocols.e2e import Sender
from controller.guard.__main__ import DATABASES
from controller.guard.carrier import MESSAGES, Carrier
from controller.guard.envelope import CarrierLimits
from controller.guard.layout import read_layouts
from controller.guard.verdicts import Finding
from tests.controller.bench import CODECS, MS

LIMITS = CarrierLimits(
    speed_limit_m_s=2.0, drive_acceleration_m_s2=0.4, articulation_limit_rad=0.5, articulation_rate_limit_rad_s=0.2
)
LAYOUTS = read_layouts(DATABASES / "machine.dbc", list(MESSAGES))
STANDING = {"ArmKey": 0xA, "Brake": 100.0}
ROLLING = {"ArmKey": 0xA, "Brake": 0.0}


class Mach0:
    """The carrier's messages, fresh in every check unless they are ``gone``."""

    def __init__(self, limits: CarrierLimits = LIMITS, now_ns: int = 10**9) -> None:
        self.carrier = Carrier(limits, LAYOUTS)
        drive, arms_a, arms_b, state = *self.carrier.commands, self.carrier.state
        self.watches = {"VehCmd": drive, "ArmCmdA": arms_a, "ArmCmdB": arms_b, "VehStat": state}
        self.values: dict[str, dict] = {"VehCmd": dict(STANDING), "ArmCmdA": {}, "ArmCmdB": {}, "VehStat": {"Brake": 1}}
        self.senders = {name: Sender(CODECS[name].data_ids) for name in self.watches}
        self.gone: set[str] = set()
        self.now_ns = now_ns
        self.send()

    def send(self, **values: dict) -> None:
        for name, its in values.items():
            self.values[name] = its
        for name in self.watches.keys() - self.gone:
            codec = CODECS[name]
            data = codec.encode(*(self.values[name].get(s.name, 0) for s in codec.signals))
            frame = Frame(self.now_ns, codec.key, self.senders[name].protect(data))
            self.watches[name].receive(frame, self.now_ns)

    def judged(self, name: str, elapsed_s: float = 1.0, **its: float | None) -> Finding:
        """What the guard says to the fields of a new command."""
        self.send(**{name: its})
        return self.carrier.receive(self.watches[name], elapsed_s)

    def check(self, crane_moves: bool = False, after_ns: int = 20 * MS, **values: dict) -> Finding:
        self.now_ns += after_ns
        self.send(**values)
        return self.carrier.check(crane_moves, self.now_ns)

    def last(self, until_ns: int, crane_moves: bool = False) -> Finding:
        """The finding at a time, with checks every 20 ms on the way."""
        while self.now_ns + 20 * MS < until_ns:
            self.check(crane_moves)
        return self.check(crane_moves, until_ns - self.now_ns)
