"""Start-up of the encoders: identity, range, TPDO1 mapping, heartbeat, then NMT start; one SDO at a time per node.

A state machine that sends at most one request per tick over all nodes, so that no tick is long and the bus stays free.
From the first tick on every node is silenced and configured, with 300 ms per request and 3 tries; a node that does not
answer is tried again without end.  A node that restarts is set up again.  A failure is a `Reason` with the node number;
a node of the wrong identity is not tried again before a reset.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from can_dbc.dbc.codec import Database
from can_dbc.frame import RawFrame
from can_dbc.protocols.canopen import (
    NmtCommand,
    Sdo,
    SdoKind,
    download_request,
    nmt_frame,
    parse_response,
    upload_request,
)
from machine.joints import JOINTS, N_JOINTS
from machine.profile import Encoder, Profile, encoders
from machine.status.reasons import Reason
from runtime.errors import ConfigError

TIMEOUT_NS: Final = 300_000_000
MAX_TRIES: Final = 3
HEARTBEAT_MS: Final = 100
TPDO1: Final = 0x180
_DISABLED: Final = 0x8000_0000
_REMEMBERED: Final = (0x6000, 0x6003, 0x6509)
"""Code sequence, preset and offset (docs/reference/can-bus.md section 3): a device that loses them has another zero."""
# CiA 406 mappings of docs/reference/can-bus.md section 3: index(16) sub(8) bits(8).
TPDO1_MAPPINGS: Final = {
    "rotary": (0x6004_0020, 0x2120_0010, 0x6503_0010),
    "linear": (0x6004_0020, 0x6030_0110, 0x5122_0108, 0x5122_0208),
}


class Request(NamedTuple):
    """One SDO: a write of ``size`` bytes, or with size 0 a read to compare (``value`` None: to remember)."""

    entry: int
    sub: int
    value: int | None
    size: int = 0


def sequence(encoder: Encoder) -> tuple[Request, ...]:
    """Build the SDO requests that set up one encoder, in order."""
    cob = TPDO1 + encoder.node
    if encoder.kind == "rotary":
        scale = Request(0x6001, 0, encoder.total_counts)
    else:
        scale = Request(0x6005, 1, round(encoder.unit_per_count * 1e9))  # nm per step
    mapping = TPDO1_MAPPINGS[encoder.kind]
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
    """Phase of the set-up of one node."""

    SILENCING = 0
    """The node is sent to pre-operational, so that its PDOs are silent."""
    CONFIGURING = 1
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
        """Begin again."""
        self.phase = Phase.SILENCING
        self.reason = Reason.NODE_ABSENT
        self._step = self._tries = self._deadline_ns = 0

    def frame(self, now_ns: int) -> RawFrame | None:
        """Return the next frame to this node, if one is due."""
        if self.phase is Phase.SILENCING:
            self.phase = Phase.CONFIGURING
            return nmt_frame(NmtCommand.ENTER_PRE_OPERATIONAL, self.node)
        if self.phase is Phase.STARTING:
            self.phase, self.reason = Phase.READY, Reason.NONE
            return nmt_frame(NmtCommand.START, self.node)
        if self.phase is not Phase.CONFIGURING or now_ns < self._deadline_ns:
            return None
        if self._tries == MAX_TRIES:
            self.restart()
            return None
        self._tries += 1
        self._deadline_ns = now_ns + TIMEOUT_NS
        index, sub, value, size = self.requests[self._step]
        if size and value is not None:
            return download_request(self.node, index, sub, value.to_bytes(size, "little"))
        return upload_request(self.node, index, sub)

    def receive(self, response: Sdo) -> None:
        """Use a response; one that does not belong to the open request is ignored."""
        index, sub, value, size = self.requests[self._step]
        waiting = self.phase is Phase.CONFIGURING and self._tries > 0
        if not waiting or (response.index, response.sub) != (index, sub):
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
    """Set-up of all encoders; `step` appends the frames to send."""

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
        """Tell why it is not complete: the worst reason and its node."""
        worst = max(self._setups, key=lambda s: s.reason, default=None)
        return (worst.reason, worst.node) if worst is not None and worst.reason else (Reason.NONE, 0)

    def reset(self, operational: Callable[[int], bool]) -> None:
        """Set up failed nodes, and those that left OPERATIONAL by themselves, again: an operator's reset."""
        self._released = False
        for setup in self._setups:
            if setup.phase is Phase.FAILED or (setup.phase is Phase.READY and not operational(setup.node)):
                setup.restart()

    def restart(self) -> None:
        """Set up every node again, because its state is unknown."""
        self._released = False
        for setup in self._setups:
            setup.restart()

    def receive(self, key: int, data: bytes) -> bool:
        """Use a frame; True when it was an SDO answer of one of the encoders."""
        response = parse_response(key, data)
        setup = None if response is None else self._by_node.get(response.node)
        if response is None or setup is None:
            return False
        setup.receive(response)
        return True

    def node_booted(self, node: int) -> None:
        """Note a boot-up frame: the node lost its set-up and waits for START."""
        self._released = False
        setup = self._by_node.get(node)
        if setup is not None:
            setup.restart()

    def step(self, now_ns: int, frames: list[RawFrame]) -> None:
        """Append the next frame, at most one per tick."""
        if self._released:  # every node is set up and started; `restart`, `reset` and `node_booted` clear this
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
    """Check that every encoder's node sends the message it names; start-up would write to another device otherwise.

    Raises:
        ConfigError: a node of the profile does not fit its message.
    """
    for joint_number, encoder in encoders(profile).items():
        key = database.message(encoder.message).key
        if key != TPDO1 + encoder.node:
            is_crane_joint = joint_number < N_JOINTS
            where = (
                f"joints.{JOINTS[joint_number].name.lower()}.encoder"
                if is_crane_joint
                else "carrier.articulation_encoder"
            )
            raise ConfigError(
                "config.encoder-node",
                f"{where}.node: node {encoder.node} does not send {encoder.message} ({key:03X}); "
                f"use node {key - TPDO1} or another message.",
            )
    imu = profile.imu
    if imu is not None and database.message(imu.message).key != TPDO1 + imu.node:
        key = database.message(imu.message).key
        raise ConfigError(
            "config.imu-node",
            f"imu.node: node {imu.node} does not send {imu.message} ({key:03X}); use node {key - TPDO1}.",
        )
