"""Start-up of the encoders: identity, range, TPDO1 mapping, heartbeat, then NMT start; one SDO at a time per
node.

A state machine that advances by at most one request per tick over all nodes, so that no tick is long and the bus
stays free.  Every node is silenced and asked from the first tick on, 300 ms per request, 3 tries, and one that does not
answer is asked again for ever.  A node that restarts is set up again.  Failures are a `Reason` with the node number; a
wrong node is not asked again before a reset.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from can_dbc.canopen import (
    NmtCommand,
    Sdo,
    SdoKind,
    Wire,
    download_request,
    nmt_frame,
    parse_response,
    upload_request,
)
from can_dbc.codec import Database
from controller.config import ConfigError
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Encoder, Profile, encoders
from machine.reasons import Reason

TIMEOUT_NS: Final = 300_000_000
TRIES: Final = 3
HEARTBEAT_MS: Final = 100
TPDO1: Final = 0x180
_DISABLED: Final = 0x8000_0000
_REMEMBERED: Final = (0x6000, 0x6003, 0x6509)
"""Code sequence, preset and offset (can_bus.md section 3): a device that loses them counts from another zero."""
# CiA 406 mappings of can_bus.md section 3: index(16) sub(8) bits(8).
_MAPPINGS: Final = {
    "rotary": (0x6004_0020, 0x2120_0010, 0x6503_0010),
    "linear": (0x6004_0020, 0x6030_0110, 0x5122_0108, 0x5122_0208),
}


class Request(NamedTuple):
    """One SDO: a write of ``size`` bytes, or with size 0 a read to compare (``value`` None: to note)."""

    entry: int
    sub: int
    value: int | None
    size: int = 0


def sequence(encoder: Encoder) -> tuple[Request, ...]:
    """The SDO requests that set up one encoder, in order."""
    cob = TPDO1 + encoder.node
    if encoder.kind == "rotary":
        scale = Request(0x6001, 0, encoder.total_counts)
    else:
        scale = Request(0x6005, 1, round(encoder.unit_per_count * 1e9))  # nm per step
    mapping = _MAPPINGS[encoder.kind]
    return (
        Request(0x1000, 0, encoder.device_type),
        Request(0x1018, 1, None),
        *(Request(entry, 0, None) for entry in _REMEMBERED),
        scale,
        Request(0x6002, 0, encoder.total_counts),
        Request(0x1800, 1, _DISABLED | cob, 4),
        Request(0x1A00, 0, 0, 1),
        *(Request(0x1A00, i, word, 4) for i, word in enumerate(mapping, 1)),
        Request(0x1A00, 0, len(mapping), 1),
        Request(0x1800, 2, 1, 1),
        Request(0x1800, 1, cob, 4),
        Request(0x1017, 0, HEARTBEAT_MS, 2),
        Request(0x1A00, 0, len(mapping)),
    )


class Phase(IntEnum):
    """Where the set-up of one node stands."""

    SILENCING = 0
    """To be sent to pre-operational, so that its PDOs are silent."""
    ASKING = 1
    STARTING = 2
    READY = 3
    FAILED = 4


class EncoderSetup:
    """Set-up of one encoder node."""

    __slots__ = ("_deadline_ns", "_first", "_step", "_tries", "node", "phase", "reason", "requests")

    def __init__(self, encoder: Encoder) -> None:
        self.node = encoder.node
        self.requests = sequence(encoder)
        self._first: dict[tuple[int, int], int] = {}
        self.restart()

    def restart(self) -> None:
        """Begins again."""
        self.phase = Phase.SILENCING
        self.reason = Reason.NODE_ABSENT
        self._step = self._tries = self._deadline_ns = 0

    def frame(self, now_ns: int) -> Wire | None:
        """The frame this node is due, if any."""
        if self.phase is Phase.SILENCING:
            self.phase = Phase.ASKING
            return nmt_frame(NmtCommand.ENTER_PRE_OPERATIONAL, self.node)
        if self.phase is Phase.STARTING:
            self.phase, self.reason = Phase.READY, Reason.NONE
            return nmt_frame(NmtCommand.START, self.node)
        if self.phase is not Phase.ASKING or now_ns < self._deadline_ns:
            return None
        if self._tries == TRIES:
            self.restart()
            return None
        self._tries += 1
        self._deadline_ns = now_ns + TIMEOUT_NS
        index, sub, value, size = self.requests[self._step]
        if size and value is not None:
            return download_request(self.node, index, sub, value.to_bytes(size, "little"))
        return upload_request(self.node, index, sub)

    def answer(self, response: Sdo) -> None:
        """Takes a response; one that does not belong to the open request is ignored."""
        index, sub, value, size = self.requests[self._step]
        asked = self.phase is Phase.ASKING and self._tries > 0
        if not asked or (response.index, response.sub) != (index, sub):
            return
        if response.kind is not (SdoKind.DOWNLOAD if size else SdoKind.UPLOAD):
            self._fail(Reason.NODE_CONFIGURATION)
            return
        if not size:
            got = response.unsigned
            if value is None:  # remembered, so that a device swapped or a preset lost at run time is noticed
                value = self._first.setdefault((index, sub), got)
            if got != value:
                self._fail(Reason.NODE_IDENTITY)
                return
        self._step += 1
        self._tries = self._deadline_ns = 0
        if self._step == len(self.requests):
            self.phase, self._step = Phase.STARTING, 0

    def _fail(self, reason: Reason) -> None:
        self.phase, self.reason = Phase.FAILED, reason


class Startup:
    """Set-up of all encoders; `step` gives the frames to send."""

    __slots__ = ("_by_node", "_released", "_setups", "_turn")

    def __init__(self, profile: Profile) -> None:
        self._setups = [EncoderSetup(encoder) for encoder in encoders(profile).values()]
        self._by_node = {s.node: s for s in self._setups}
        self._turn = 0
        self._released = False

    @property
    def complete(self) -> bool:
        """Whether every encoder is set up and started."""
        return all(s.phase is Phase.READY for s in self._setups)

    def problem(self) -> tuple[Reason, int]:
        """Why it is not complete: the worst reason and its node."""
        worst = max(self._setups, key=lambda s: s.reason, default=None)
        return (worst.reason, worst.node) if worst is not None and worst.reason else (Reason.NONE, 0)

    def reset(self, operational: Callable[[int], bool]) -> None:
        """An operator's reset: failed nodes, and those that left OPERATIONAL by themselves, are set up again."""
        self._released = False
        for setup in self._setups:
            if setup.phase is Phase.FAILED or (setup.phase is Phase.READY and not operational(setup.node)):
                setup.restart()

    def again(self) -> None:
        """Every node is set up anew: nobody knows what happened to it."""
        self._released = False
        for setup in self._setups:
            setup.restart()

    def receive(self, key: int, data: bytes) -> bool:
        """Takes a frame; True when it was an SDO answer of one of our encoders."""
        response = parse_response(key, data)
        setup = None if response is None else self._by_node.get(response.node)
        if response is None or setup is None:
            return False
        setup.answer(response)
        return True

    def booted(self, node: int) -> None:
        """A boot-up frame: the set-up of this node is gone, and whoever it is waits for START."""
        self._released = False
        setup = self._by_node.get(node)
        if setup is not None:
            setup.restart()

    def step(self, now_ns: int, frames: list[Wire]) -> None:
        """Appends what this tick has to say: at most one frame."""
        if self._released:  # everything is set up and started; whatever undoes that takes this back
            return
        n = len(self._setups)
        for k in range(n):
            frame = self._setups[(self._turn + k) % n].frame(now_ns)
            if frame is not None:
                self._turn = (self._turn + k + 1) % n
                frames.append(frame)
                return
        if self.complete:
            self._released = True
            frames.append(nmt_frame(NmtCommand.START))


def check_nodes(database: Database, profile: Profile) -> None:
    """Refuses a profile whose node cannot send the message it names, for start-up would write to another device; raises
    ConfigError."""
    for place, encoder in encoders(profile).items():
        key = database.message(encoder.message).key
        if key != TPDO1 + encoder.node:
            jointed = place < N_JOINTS
            where = f"joints.{JOINTS[place].name.lower()}.encoder" if jointed else "carrier.articulation_encoder"
            raise ConfigError(
                f"{where}.node: node {encoder.node} does not send {encoder.message} ({key:03X}); "
                f"give it node {key - TPDO1} or another message"
            )
    imu = profile.imu
    if imu is not None and database.message(imu.message).key != TPDO1 + imu.node:
        key = database.message(imu.message).key
        raise ConfigError(
            f"imu.node: node {imu.node} does not send {imu.message} ({key:03X}); give it node {key - TPDO1}"
        )
