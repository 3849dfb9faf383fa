"""The core of a CANopen slave: its NMT state and its SDO server, as pure functions of the frames that arrive.

Used by the simulated devices of `sim` and by the nodes that the PLC bridge emulates.  Sending the boot-up message and
the heartbeat is up to the owner, because each has its own timer.  Sources: CiA 301 4.2 (sections 7.2.4, 7.2.8).
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Final

from can_dbc.frame import RawFrame
from can_dbc.protocols.canopen import (
    SDO_TO_CLIENT,
    NmtCommand,
    NodeState,
    SdoKind,
    abort_frame,
    download_response,
    parse_request,
    upload_response,
)

Objects = dict[tuple[int, int], bytes]
"""An object dictionary: (index, sub-index) to little-endian value."""

HEARTBEAT_MS: Final = 100

# SDO abort codes (CiA 301, table 22).
_NO_OBJECT, _READ_ONLY, _WRONG_LENGTH, _NO_SEGMENTS = 0x0602_0000, 0x0601_0002, 0x0607_0010, 0x0504_0001


def identity_objects(node: int) -> Objects:
    """The objects that CiA 301 demands of every node: device type, error register, heartbeat period, identity."""
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
        """Accepts the payload of an NMT command frame; ignores it when it is malformed or for another node."""
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
        """Called after an NMT reset; the owner discards its run-time state here."""

    def sdo_answer(self, key: int, data: bytes) -> RawFrame | None:
        """The answer to an SDO request to this node; None for any other frame and for an abort."""
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
