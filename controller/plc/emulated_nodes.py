"""The CANopen nodes that the bridge plays on crane0: NMT, heartbeat, object dictionary, and an encoder's TPDO1.

Pure.  A node answers only while the PLC behind it lives; when it comes back after a silence it boots, so that the
controller sets it up again as it would a device that had lost its supply.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from can_dbc.canopen import (
    SDO_TO_CLIENT,
    NmtCommand,
    NodeState,
    SdoKind,
    Wire,
    abort_frame,
    download_response,
    heartbeat_frame,
    parse_request,
    upload_response,
)
from can_dbc.codec import MessageCodec
from controller.outputs import Every
from machine.encoder import counts_from_position
from machine.profile import Encoder

HEARTBEAT_NS: Final = 100_000_000
_NO_OBJECT, _READ_ONLY, _WRONG_LENGTH, _NO_SEGMENTS = 0x0602_0000, 0x0601_0002, 0x0607_0010, 0x0504_0001
_NOT_VALID: Final = 0x8000_0000
_TPDO1: Final = 0x180
_MAPPINGS: Final = {
    "rotary": (0x6004_0020, 0x2120_0010, 0x6503_0010),
    "linear": (0x6004_0020, 0x6030_0110, 0x5122_0108, 0x5122_0208),
}
Objects = dict[tuple[int, int], bytes]


class PlayedNode:
    """A node with heartbeat and SDO server.  ``starts`` says whether it goes operational by itself."""

    def __init__(self, node: int, objects: Objects, starts: bool) -> None:
        self.node = node
        self._initial: Objects = {
            (0x1000, 0): bytes(4), (0x1001, 0): bytes(1), (0x1017, 0): (100).to_bytes(2, "little"),
            (0x1018, 0): b"\x02", (0x1018, 1): bytes(4), (0x1018, 2): node.to_bytes(4, "little"),
        } | objects  # fmt: skip
        self._starts = starts
        self._writable: frozenset[tuple[int, int]] = frozenset()
        self._heartbeat = Every(HEARTBEAT_NS)
        self.boot()

    def boot(self) -> None:
        """As after power-on."""
        self.state = NodeState.BOOT_UP
        self.objects = dict(self._initial)

    @property
    def operational(self) -> bool:
        """Whether it sends its PDOs."""
        return self.state is NodeState.OPERATIONAL

    def receive_nmt(self, data: bytes) -> None:
        """An NMT command."""
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
                self.boot()

    def receive_sdo(self, key: int, data: bytes) -> Wire | None:
        """The answer to an SDO request to this node."""
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

    def tick(self, now_ns: int, out: list[Wire]) -> None:
        """Boot-up message and heartbeat."""
        if self.state is NodeState.BOOT_UP:
            out.append(heartbeat_frame(self.node, NodeState.BOOT_UP))
            self.state = NodeState.OPERATIONAL if self._starts else NodeState.PRE_OPERATIONAL
        elif self._heartbeat.due(now_ns):
            out.append(heartbeat_frame(self.node, self.state))


class PlayedEncoder(PlayedNode):
    """A CiA 406 encoder whose position is the PLC's."""

    def __init__(self, spec: Encoder, codec: MessageCodec) -> None:
        self._spec, self._codec = spec, codec
        cob = _TPDO1 + spec.node
        scale: Objects = (
            {(0x6001, 0): spec.total_counts.to_bytes(4, "little")}
            if spec.kind == "rotary"
            else {(0x6005, 1): round(spec.unit_per_count * 1e9).to_bytes(4, "little")}
        )
        communication: Mapping[tuple[int, int], bytes] = {
            (0x1800, 1): (_NOT_VALID | cob).to_bytes(4, "little"), (0x1800, 2): b"\x01", (0x1A00, 0): b"\x00",
        } | {(0x1A00, i): bytes(4) for i in range(1, 5)}  # fmt: skip
        super().__init__(
            spec.node,
            {
                (0x1000, 0): spec.device_type.to_bytes(4, "little"), (0x6000, 0): bytes(2), (0x6003, 0): bytes(4),
                (0x6509, 0): bytes(4), (0x6002, 0): spec.total_counts.to_bytes(4, "little"),
            } | scale | dict(communication),
            starts=False,
        )  # fmt: skip
        self._writable = frozenset(communication) | {(0x1017, 0)}
        self._mapping = _MAPPINGS[spec.kind]

    def answer(self, position: float, velocity: float, now_ns: int) -> Wire | None:
        """TPDO1 in answer to SYNC, when it is set up for that as crane.dbc says."""
        if not self.operational or not self._mapped():
            return None
        spec = self._spec
        counts = counts_from_position(spec, position)
        if spec.kind == "rotary":
            return self._codec.key, self._codec.encode(counts, now_ns // 1000 & 0xFFFF, 0)
        steps = round(spec.direction * velocity / spec.unit_per_count)
        return self._codec.key, self._codec.encode(counts, min(max(steps, -32768), 32767), 0, 0)

    def _mapped(self) -> bool:
        o, mapping = self.objects, self._mapping
        return (
            int.from_bytes(o[0x1800, 1], "little") == self._codec.key
            and 1 <= o[0x1800, 2][0] <= 240
            and o[0x1A00, 0][0] == len(mapping)
            and all(int.from_bytes(o[0x1A00, i], "little") == word for i, word in enumerate(mapping, 1))
        )


class Between:
    """A value that arrives in steps and is passed on without steps: linear from one sample to the next, one late."""

    def __init__(self) -> None:
        self._from = self._to = 0.0
        self._begin_ns = self._span_ns = 0
        self._known = False

    def forget(self) -> None:
        """The next sample stands alone."""
        self._known = False

    def sample(self, value: float, now_ns: int, longest_ns: int) -> None:
        """A new sample; it is reached as long after now as the last one came before, at most ``longest_ns``."""
        since_ns = now_ns - self._begin_ns
        self._from = self.at(now_ns) if self._known else value
        self._to, self._begin_ns, self._span_ns = value, now_ns, max(1, min(since_ns, longest_ns))
        self._known = True

    def at(self, now_ns: int) -> float:
        """The value to pass on."""
        share = min(1.0, max(0.0, (now_ns - self._begin_ns) / self._span_ns)) if self._span_ns else 1.0
        return self._from + share * (self._to - self._from)
