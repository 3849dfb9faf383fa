"""The CANopen nodes that the bridge emulates on crane0: NMT, heartbeat, object dictionary, and an encoder's TPDO1.

Pure.  A node answers only while the PLC behind it does; when the PLC answers again after a silence the node boots, so
that the controller sets it up again like a device that had lost its supply.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Final

from can_dbc.dbc.codec import MessageCodec
from can_dbc.frame import RawFrame
from can_dbc.protocols.canopen import NodeState, heartbeat_frame
from can_dbc.protocols.canopen_slave import HEARTBEAT_MS, CanopenSlave, Objects
from controller.bus_io import PeriodicTimer
from controller.crane.startup import TPDO1, TPDO1_MAPPINGS
from machine.profile import Encoder
from machine.sensing.encoder import counts_from_position

HEARTBEAT_NS: Final = HEARTBEAT_MS * 1_000_000
_NOT_VALID: Final = 0x8000_0000


class EmulatedNode(CanopenSlave):
    """A node with heartbeat and SDO server; with ``starts`` it becomes operational by itself."""

    def __init__(self, node: int, objects: Objects, starts: bool, writable: Set[tuple[int, int]] = frozenset()) -> None:
        super().__init__(node, objects, writable)
        self._initial = dict(self.objects)
        self._starts = starts
        self._heartbeat = PeriodicTimer(HEARTBEAT_NS)

    def boot(self) -> None:
        """As after power-on."""
        self.state = NodeState.BOOT_UP
        self.restart()

    def restart(self) -> None:
        """Reset the object dictionary to its initial values."""
        self.objects = dict(self._initial)

    def step(self, now_ns: int, out: list[RawFrame]) -> None:
        """Append the boot-up message or the heartbeat that is due."""
        if self.state is NodeState.BOOT_UP:
            out.append(heartbeat_frame(self.node, NodeState.BOOT_UP))
            self.state = NodeState.OPERATIONAL if self._starts else NodeState.PRE_OPERATIONAL
        elif self._heartbeat.due(now_ns):
            out.append(heartbeat_frame(self.node, self.state))


class EmulatedEncoder(EmulatedNode):
    """A CiA 406 encoder with the PLC's position."""

    def __init__(self, spec: Encoder, codec: MessageCodec) -> None:
        self._spec, self._codec = spec, codec
        cob = TPDO1 + spec.node
        scale: Objects = (
            {(0x6001, 0): spec.total_counts.to_bytes(4, "little")}
            if spec.kind == "rotary"
            else {(0x6005, 1): round(spec.unit_per_count * 1e9).to_bytes(4, "little")}
        )
        communication: Mapping[tuple[int, int], bytes] = {
            (0x1800, 1): (_NOT_VALID | cob).to_bytes(4, "little"),
            (0x1800, 2): b"\x01",
            (0x1A00, 0): b"\x00",
        } | {(0x1A00, i): bytes(4) for i in range(1, 5)}
        super().__init__(
            spec.node,
            {
                (0x1000, 0): spec.device_type.to_bytes(4, "little"),
                (0x6000, 0): bytes(2),
                (0x6003, 0): bytes(4),
                (0x6509, 0): bytes(4),
                (0x6002, 0): spec.total_counts.to_bytes(4, "little"),
            }
            | scale
            | dict(communication),
            starts=False,
            writable=frozenset(communication) | {(0x1017, 0)},
        )
        self._mapping = TPDO1_MAPPINGS[spec.kind]

    def answer(self, position: float, velocity: float, sampled_us: int) -> RawFrame | None:
        """TPDO1 of a sample that the PLC read at ``sampled_us`` by its own clock; None unless it is configured as in
        crane.dbc.
        """
        if not self.operational or not self._mapped():
            return None
        spec = self._spec
        counts = counts_from_position(spec, position)
        if spec.kind == "rotary":
            return self._codec.key, self._codec.encode(counts, sampled_us, 0)
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
