"""CANopen on the fast path: NMT, heartbeat, emergency and expedited SDO as pure functions.

Frames are ``(key, data)`` with keys of ``can_dbc.frame``; time is ``now_ns``, monotonic.  Nothing here waits: an SDO
transfer is a request frame now and a response frame in a later tick.  Parsing a frame of another kind returns None,
never raises.  Sources: CiA 301 4.2 (sections 7.2.4, 7.2.8).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Set
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from can_dbc.frame import RawFrame

NMT_ID: Final = 0x000
SYNC_ID: Final = 0x080
EMCY_BASE: Final = 0x080
SDO_TO_CLIENT: Final = 0x580
SDO_TO_SERVER: Final = 0x600
HEARTBEAT_BASE: Final = 0x700
MAX_NODE: Final = 127


class NmtCommand(IntEnum):
    """NMT node control."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NodeState(IntEnum):
    """State in a heartbeat."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def nmt_frame(command: NmtCommand, node: int = 0) -> RawFrame:
    """Build the NMT command for a node, or for all nodes with 0."""
    return NMT_ID, bytes((command, node))


def sync_frame(counter: int) -> RawFrame:
    """Build the SYNC with its counter, 1 to 240; see ``next_sync``."""
    return SYNC_ID, bytes((counter,))


def next_sync(counter: int) -> int:
    """Return the SYNC counter after ``counter``: 1 to 240, then 1 again (1019h = 240)."""
    return counter % 240 + 1


def heartbeat_frame(node: int, state: NodeState) -> RawFrame:
    """Build the heartbeat of a node; BOOT_UP is the boot-up message."""
    return HEARTBEAT_BASE + node, bytes((state,))


def parse_heartbeat(key: int, data: bytes) -> tuple[int, int] | None:
    """Parse (node, state byte without the toggle bit) from a heartbeat frame."""
    node = key - HEARTBEAT_BASE
    return (node, data[0] & 0x7F) if 0 < node <= MAX_NODE and len(data) == 1 else None


# -- emergency ---------------------------------------------------------------------------------------------


class Emergency(NamedTuple):
    """An emergency message: error code, error register 1001h and five manufacturer bytes."""

    node: int
    code: int
    register: int
    manufacturer: bytes

    @property
    def text(self) -> str:
        """The meaning of the code's class (CiA 301, table 26)."""
        exact = EMERGENCY_CODES.get(self.code)
        return exact or EMERGENCY_CLASSES.get(self.code >> 8) or EMERGENCY_CLASSES.get(self.code >> 8 & 0xF0, "unknown")


EMERGENCY_CODES: Final = {
    0x8110: "CAN overrun",
    0x8120: "CAN error passive",
    0x8130: "heartbeat or life guard error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision",
    0x8210: "PDO length too short",
    0x8220: "PDO too long",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO timeout",
}
EMERGENCY_CLASSES: Final = {
    0x00: "no error, or error reset",
    0x10: "generic error",
    0x20: "current",
    0x30: "voltage",
    0x40: "temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device specific",
}


def parse_emergency(key: int, data: bytes) -> Emergency | None:
    """Parse the emergency message in a frame."""
    node = key - EMCY_BASE
    if not 0 < node <= MAX_NODE or len(data) != 8:
        return None
    return Emergency(node, data[0] | data[1] << 8, data[2], data[3:8])


def emergency_frame(emergency: Emergency) -> RawFrame:
    """Build the frame of an emergency message; the manufacturer bytes are padded with zeros."""
    data = struct.pack("<HB5s", emergency.code, emergency.register, emergency.manufacturer)
    return EMCY_BASE + emergency.node, data


# -- heartbeat monitor -------------------------------------------------------------------------------------


class Presence(IntEnum):
    """Presence of a node according to its heartbeat."""

    WAITING = 0
    ALIVE = 1
    LOST = 2
    NEVER_SEEN = 3


class HeartbeatMonitor:
    """Monitors the heartbeats of the nodes that must be present.

    A CANopen heartbeat consumer starts with the first heartbeat and so never reports a node that is dead at boot.  Here
    a node without a heartbeat until ``boot_timeout_ns`` after ``start_ns`` is NEVER_SEEN; one that is silent for its
    own timeout is LOST.  ``timeouts_ns`` maps a node to that timeout.  ``boots`` counts boot-up messages, so that a
    restart between two ticks is detected although the heartbeats continue.
    """

    __slots__ = ("_boot_deadline_ns", "_seen_ns", "_timeouts_ns", "boots", "states")

    def __init__(self, timeouts_ns: Mapping[int, int], boot_timeout_ns: int, start_ns: int) -> None:
        self._timeouts_ns = dict(timeouts_ns)
        self._boot_deadline_ns = start_ns + boot_timeout_ns
        self._seen_ns: dict[int, int] = {}
        self.states: dict[int, int] = {}
        self.boots = dict.fromkeys(self._timeouts_ns, 0)

    def forget(self) -> None:
        """Return to the state before the first heartbeat; keeps the counts of boots."""
        self._seen_ns.clear()
        self.states.clear()

    def receive(self, key: int, data: bytes, now_ns: int) -> bool:
        """Accept a frame; False if it is not a heartbeat of a monitored node."""
        parsed = parse_heartbeat(key, data)
        if parsed is None or parsed[0] not in self._timeouts_ns:
            return False
        node, state = parsed
        self._seen_ns[node] = now_ns
        self.states[node] = state
        if state == NodeState.BOOT_UP:
            self.boots[node] += 1
        return True

    def presence(self, node: int, now_ns: int) -> Presence:
        """Return the presence of a monitored node at ``now_ns``."""
        seen_ns = self._seen_ns.get(node)
        if seen_ns is None:
            return Presence.WAITING if now_ns < self._boot_deadline_ns else Presence.NEVER_SEEN
        return Presence.ALIVE if now_ns - seen_ns <= self._timeouts_ns[node] else Presence.LOST

    def age_ns(self, node: int, now_ns: int) -> int:
        """Return the time since the last heartbeat of a node; since the clock's zero for a node that sent none."""
        return now_ns - self._seen_ns.get(node, 0)

    def operational(self, node: int, now_ns: int) -> bool:
        """Tell whether a node is alive and OPERATIONAL."""
        return self.states.get(node) == NodeState.OPERATIONAL and self.presence(node, now_ns) is Presence.ALIVE

    def next_loss_ns(self) -> int:
        """Compute the time until which every node seen so far stays ALIVE without further heartbeats."""
        timeouts_ns, first_ns = self._timeouts_ns, 0
        for node, seen_ns in self._seen_ns.items():
            loss_ns = seen_ns + timeouts_ns[node]
            if not first_ns or loss_ns < first_ns:
                first_ns = loss_ns
        return first_ns

    def missing(self, now_ns: int) -> tuple[int, ...]:
        """List the nodes that are LOST or NEVER_SEEN."""
        return tuple(n for n in self._timeouts_ns if self.presence(n, now_ns) >= Presence.LOST)


# -- SDO -----------------------------------------------------------------------------------------------------


class SdoKind(IntEnum):
    """Kind of an SDO frame; SEGMENTED is a transfer of more than four bytes, which is not supported here."""

    UPLOAD = 0
    DOWNLOAD = 1
    ABORT = 2
    SEGMENTED = 3


@dataclass(frozen=True, slots=True)
class Sdo:
    """A parsed SDO frame.  ``data`` is the value, little-endian; ``abort`` the abort code, 0 without one."""

    kind: SdoKind
    node: int
    index: int
    sub: int
    data: bytes
    abort: int

    @property
    def unsigned(self) -> int:
        """The value as an unsigned number."""
        return int.from_bytes(self.data, "little")


def upload_request(node: int, index: int, sub: int) -> RawFrame:
    """Build a client's request for an object of a node."""
    return SDO_TO_SERVER + node, struct.pack("<BHB4x", 0x40, index, sub)


def download_request(node: int, index: int, sub: int, data: bytes) -> RawFrame:
    """Build a client's request to write 1 to 4 bytes, little-endian, to an object of a node."""
    return SDO_TO_SERVER + node, _expedited(0x23, index, sub, data)


def upload_response(node: int, index: int, sub: int, data: bytes) -> RawFrame:
    """Build a server's frame to answer an upload with 1 to 4 bytes."""
    return SDO_TO_CLIENT + node, _expedited(0x43, index, sub, data)


def download_response(node: int, index: int, sub: int) -> RawFrame:
    """Build a server's frame to confirm a download."""
    return SDO_TO_CLIENT + node, struct.pack("<BHB4x", 0x60, index, sub)


def abort_frame(base: int, node: int, index: int, sub: int, code: int) -> RawFrame:
    """Build the abort with which either side ends a transfer; ``base`` is SDO_TO_CLIENT or SDO_TO_SERVER."""
    return base + node, struct.pack("<BHBI", 0x80, index, sub, code)


def parse_response(key: int, data: bytes) -> Sdo | None:
    """Parse a server's response for a client; UPLOAD carries the value, DOWNLOAD is the confirmation."""
    return _parse(key - SDO_TO_CLIENT, data, SdoKind.UPLOAD, carrying=2, bare=3)


def parse_request(key: int, data: bytes) -> Sdo | None:
    """Parse a client's request for a server; DOWNLOAD carries the value, UPLOAD requests it."""
    return _parse(key - SDO_TO_SERVER, data, SdoKind.DOWNLOAD, carrying=1, bare=2)


def _expedited(command: int, index: int, sub: int, data: bytes) -> bytes:
    if not 1 <= len(data) <= 4:
        raise ValueError(f"an expedited transfer carries 1 to 4 bytes, not {len(data)}")
    return struct.pack("<BHB4s", command | (4 - len(data)) << 2, index, sub, data)


def _parse(node: int, data: bytes, value_kind: SdoKind, carrying: int, bare: int) -> Sdo | None:
    """Parse an SDO; ``carrying`` and ``bare``: the specifiers with a value (of ``value_kind``) and without one."""
    if not 0 < node <= MAX_NODE or len(data) != 8:
        return None
    command, index, sub, value = struct.unpack("<BHB4s", data)
    specifier, expedited, sized = command >> 5, command & 2, command & 1
    if specifier == 4:
        return Sdo(SdoKind.ABORT, node, index, sub, b"", int.from_bytes(value, "little"))
    if specifier == carrying and expedited:
        return Sdo(value_kind, node, index, sub, value[: 4 - (command >> 2 & 3)] if sized else value, 0)
    if specifier == bare:
        return Sdo(SdoKind(1 - value_kind), node, index, sub, b"", 0)
    return Sdo(SdoKind.SEGMENTED, node, index, sub, value, 0)


# -- The core of a CANopen slave: its NMT state and its SDO server, as pure functions of the frames that arrive.
#
# Used by the simulated devices of `sim` and by the nodes that the PLC bridge emulates.  Sending the boot-up message
# and the heartbeat is up to the owner, because each has its own timer.  Sources: CiA 301 4.2 (sections 7.2.4,
# 7.2.8).

Objects = dict[tuple[int, int], bytes]
"""An object dictionary: (index, sub-index) to little-endian value."""

HEARTBEAT_MS: Final = 100

# SDO abort codes (CiA 301, table 22).
_NO_OBJECT, _READ_ONLY, _WRONG_LENGTH, _NO_SEGMENTS = 0x0602_0000, 0x0601_0002, 0x0607_0010, 0x0504_0001


def identity_objects(node: int) -> Objects:
    """List the objects that CiA 301 demands of every node: device type, error register, heartbeat period, identity."""
    return {
        (0x1000, 0): bytes(4),
        (0x1001, 0): bytes(1),
        (0x1017, 0): HEARTBEAT_MS.to_bytes(2, "little"),
        (0x1018, 0): b"\x02",
        (0x1018, 1): bytes(4),
        (0x1018, 2): node.to_bytes(4, "little"),
    }


class CanopenSlave:
    """A node with an NMT state and an SDO server.

    Args:
        node: Node number, 1 to 127.
        objects: The object dictionary beyond and instead of `identity_objects`.
        writable: Entries that a client may write; a write must have the length of the value that is there.
    """

    def __init__(
        self, node: int, objects: Mapping[tuple[int, int], bytes], writable: Set[tuple[int, int]] = frozenset()
    ) -> None:
        self.node = node
        self.objects: Objects = identity_objects(node) | dict(objects)
        self.state = NodeState.BOOT_UP
        self._writable = writable

    @property
    def operational(self) -> bool:
        """Whether the node sends its PDOs."""
        return self.state == NodeState.OPERATIONAL

    def receive_nmt(self, data: bytes) -> None:
        """Accept the payload of an NMT command frame; ignore it when it is malformed or for another node."""
        if len(data) != 2 or data[1] not in (0, self.node):
            return
        match data[0]:
            case NmtCommand.START:
                self.state = NodeState.OPERATIONAL
            case NmtCommand.STOP:
                self.state = NodeState.STOPPED
            case NmtCommand.ENTER_PRE_OPERATIONAL:
                self.state = NodeState.PRE_OPERATIONAL
            case NmtCommand.RESET_NODE | NmtCommand.RESET_COMMUNICATION:
                self.state = NodeState.BOOT_UP
                self.restart()

    def restart(self) -> None:
        """Discard the owner's run-time state, in an override; called after an NMT reset."""

    def sdo_answer(self, key: int, data: bytes) -> RawFrame | None:
        """Answer an SDO request to this node; None for any other frame and for an abort."""
        request = parse_request(key, data)
        if request is None or request.node != self.node or request.kind is SdoKind.ABORT:
            return None
        entry = (request.index, request.sub)
        value = self.objects.get(entry)
        if value is None:
            code = _NO_OBJECT
        elif request.kind is SdoKind.UPLOAD:
            return upload_response(self.node, *entry, value)
        elif request.kind is SdoKind.SEGMENTED:
            code = _NO_SEGMENTS
        elif entry not in self._writable:
            code = _READ_ONLY
        elif len(request.data) != len(value):
            code = _WRONG_LENGTH
        else:
            self.objects[entry] = request.data
            return download_response(self.node, *entry)
        return abort_frame(SDO_TO_CLIENT, self.node, *entry, code)
