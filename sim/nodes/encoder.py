"""CANopen encoders (CiA 406) on the ``canopen`` library's LocalNode, driven synchronously on virtual time.

The library gives SDO server, object dictionary (from the project's EDS files), NMT slave, heartbeat and EMCY;
``VirtualNetwork`` replaces its bus, threads and timers.  TPDO1 answers SYNC when operational, valid and of a
synchronous type.  Read errors: quantisation, noise, eccentricity, latency, offset (``EncoderTruth``).
"""

from __future__ import annotations

import math
import random
from collections import deque
from pathlib import Path

import canopen
from canopen.network import PeriodicMessageTask
from canopen.objectdictionary import ODVariable

import can_dbc
from can_dbc.protocols.canopen import NMT_ID, SDO_TO_SERVER
from machine.profile import Encoder
from machine.sensing import counts_from_position, position_from_counts
from sim.faults import EncoderFault
from sim.nodes import Outbox
from sim.truth.sensors import EncoderTruth

EDS_FOLDER = Path(can_dbc.__file__).parent
PDO_NOT_VALID = 0x8000_0000
MAX_SYNCHRONOUS_TYPE = 240
OPERATIONAL, PRE_OPERATIONAL, INITIALISING = "OPERATIONAL", "PRE-OPERATIONAL", "INITIALISING"
EMCY_POSITION = 0x5000
TIMESTAMP_NS = 1_000  # the device's time stamp counts microseconds modulo 2**16
# COB-ID, transmission type, mapped objects as ((index, sub-index), mask, shift), length in bytes
Pdo = tuple[int, int, list[tuple[tuple[int, int], int, int]], int]


class _Periodic(PeriodicMessageTask):
    """The library's periodic task (its heartbeat) on virtual time; the base's own bus task is never started."""

    def __init__(self, network: VirtualNetwork, can_id: int, data: bytes, period: float) -> None:
        self._network, self._id, self._data = network, can_id, bytes(data)
        self._period_ns = round(period * 1e9)
        self._next_ns = network.now_ns + self._period_ns

    def update(self, data: bytes) -> None:
        self._data = bytes(data)

    def stop(self) -> None:
        self._network.periodic.remove(self)

    def tick(self, now_ns: int) -> None:
        if now_ns >= self._next_ns:
            self._next_ns += self._period_ns * max(1, -(-(now_ns - self._next_ns + 1) // self._period_ns))
            self._network.send_message(self._id, self._data)


class VirtualNetwork(canopen.Network):
    """The canopen library without bus, thread and clock: sends into an outbox, receives by ``notify``."""

    def __init__(self, outbox: Outbox) -> None:
        super().__init__(None)
        self.outbox = outbox
        self.now_ns = 0
        self.periodic: list[_Periodic] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.outbox.append((can_id, bytes(data)))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> _Periodic:
        task = _Periodic(self, can_id, data, period)
        self.periodic.append(task)
        return task


class EncoderNode:
    """One encoder.  ``observe`` feeds the true position every physics step; ``set_alarm`` sets or clears a failure, and
    ``fault`` is one that it does not know of.
    """

    def __init__(
        self, name: str, spec: Encoder, truth: EncoderTruth, step_ns: int, seed: int, network: VirtualNetwork
    ) -> None:
        self.spec, self._truth, self._network = spec, truth, network
        self._rng = random.Random(f"encoder {name} {seed}")
        self._history: deque[float] = deque(maxlen=1 + max(0, round(truth.latency_s * 1e9 / step_ns)))
        self._speed = 0.0
        self._syncs = 0
        self.alarms = 0
        self.fault: EncoderFault | None = None
        self._values = {(0x6004, 0): 0, (0x6030, 1): 0, (0x2120, 0): 0, (0x6503, 0): 0, (0x5122, 1): 0, (0x5122, 2): 0}
        self.node = canopen.LocalNode(spec.node, str(EDS_FOLDER / f"encoder_{spec.kind}.eds"))
        # The library's SDO server answers a malformed first request with the index of the request before it.
        self.node.sdo._index = self.node.sdo._subindex = 0
        self.node.sdo._buffer = bytearray()
        self.node.add_read_callback(self._read)  # type: ignore[no-untyped-call]
        self.node.add_write_callback(self._written)  # type: ignore[no-untyped-call]
        self._pdo: Pdo | None = None
        network.add_node(self.node)
        self._booted = False

    def observe(self, now_ns: int, position: float, speed: float) -> None:
        """Record the true joint position and speed at ``now_ns``."""
        self._history.append(position)
        self._now_ns = now_ns
        self._speed = speed

    def measure(self, now_ns: int) -> float:
        """Return its present reading, with all its errors [rad or m]."""
        self._sample(now_ns)
        return position_from_counts(self.spec, self._values[0x6004, 0])

    def tick(self, now_ns: int) -> None:
        """Boot after power-on or NMT reset."""
        if not self._booted or self.node.nmt.state == INITIALISING:
            self._boot()

    def _boot(self) -> None:
        self._booted = True
        stored = self.node.data_store
        stored.clear()
        self._pdo = None
        spec = self.spec
        self.node.set_data(0x1000, 0, spec.device_type.to_bytes(4, "little"))
        if spec.kind == "rotary":
            self.node.set_data(0x6001, 0, spec.total_counts.to_bytes(4, "little"))
        else:
            self.node.set_data(0x6005, 1, round(spec.unit_per_count * 1e9).to_bytes(4, "little"))
        self.node.set_data(0x6002, 0, spec.total_counts.to_bytes(4, "little"))
        self.node.nmt.send_command(0x82)  # boot-up frame
        self.node.nmt.send_command(0x80)  # pre-operational, starts the heartbeat of 1017h

    def set_alarm(self, alarms: int) -> None:
        """Set the alarm bits of 6503h (rotary) or 5122h:01 (linear); a change sends an emergency message."""
        if alarms == self.alarms:
            return
        self.alarms = alarms
        register = 0x01 if alarms else 0x00
        self.node.set_data(0x1001, 0, bytes((register,)))
        code = EMCY_POSITION if alarms else 0x0000
        self.node.emcy.send(code, register, alarms.to_bytes(2, "little"))

    def sync(self, now_ns: int) -> None:
        """Sample on a SYNC, and send TPDO1 if it is due."""
        self._sample(now_ns)
        node = self.node
        if node.nmt.state != OPERATIONAL:
            return
        if self._pdo is None:
            self._pdo = self._read_pdo()
        cob, every, mapping, length = self._pdo
        if cob & PDO_NOT_VALID or not 1 <= every <= MAX_SYNCHRONOUS_TYPE:
            return
        self._syncs += 1
        if self._syncs % every:
            return
        payload = 0
        for entry, mask, shift in mapping:
            value = self._values.get(entry)
            if value is None:
                value = int.from_bytes(node.get_data(*entry), "little")
            payload |= (value & mask) << shift
        self._network.send_message(cob & 0x7FF, payload.to_bytes(length, "little"))

    def _read_pdo(self) -> Pdo:
        """Read TPDO1 as configured; objects beyond eight bytes are left out."""
        get = self.node.get_data
        mapping, shift = [], 0
        for i in range(1, get(0x1A00, 0)[0] + 1):
            word = int.from_bytes(get(0x1A00, i), "little")
            bits = min(word & 0xF8, 64 - shift)
            mapping.append(((word >> 16, word >> 8 & 0xFF), (1 << bits) - 1, shift))
            shift += bits
        return int.from_bytes(get(0x1800, 1), "little"), get(0x1800, 2)[0], mapping, shift // 8

    def _written(self, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        if index in (0x1800, 0x1A00):
            self._pdo = None

    def _sample(self, now_ns: int) -> None:
        t, spec, v, fault = self._truth, self.spec, self._values, self.fault
        position, noise = self._history[0], self._rng.gauss(0.0, t.noise)
        if fault is not None:
            position, noise = fault.position(position, now_ns), noise * fault.noise_factor
        error = t.offset + t.eccentricity * math.sin(position + t.phase_rad) + noise
        steps = round(spec.direction * self._speed / spec.unit_per_count)
        if spec.kind == "linear":
            steps = max(-32768, min(32767, steps))
        if fault is None or not fault.frozen:
            v[0x6004, 0] = counts_from_position(spec, position + error)
            v[0x6030, 1] = steps
        v[0x2120, 0] = (now_ns // TIMESTAMP_NS) & 0xFFFF
        v[0x6503, 0] = v[0x5122, 1] = self.alarms

    def _read(self, index: int, subindex: int, od: ODVariable) -> int | None:
        if (index, subindex) == (0x6004, 0) and self._history:
            self._sample(self._now_ns)
        return self._values.get((index, subindex))


class EncoderBus:
    """All encoders on one virtual network."""

    def __init__(self, encoders: dict[str, EncoderNode], network: VirtualNetwork) -> None:
        self.encoders, self._network = encoders, network

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        """Handle NMT and SDO frames; malformed ones are ignored, as a CAN controller's filter would."""
        self._network.now_ns = now_ns
        is_sdo = SDO_TO_SERVER < key <= SDO_TO_SERVER + 0x7F and len(data) == 8
        if is_sdo or (key == NMT_ID and len(data) == 2):
            self._network.notify(key, bytearray(data), now_ns * 1e-9)

    def tick(self, now_ns: int) -> None:
        """Send boot-ups and heartbeats."""
        self._network.now_ns = now_ns
        for encoder in self.encoders.values():
            encoder.tick(now_ns)
        for task in list(self._network.periodic):
            task.tick(now_ns)

    def sync(self, now_ns: int) -> None:
        """Pass a SYNC to all."""
        for encoder in self.encoders.values():
            encoder.sync(now_ns)
