"""Received values of crane0: frames to message states by key, the nodes' own frames, and foreign command frames.

Only the newest values are kept.  Heartbeats, emergency messages and SDO answers are recognized by key; every other
frame is counted as unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame
from can_dbc.protocols.canopen import EMCY_BASE, HEARTBEAT_BASE, SDO_TO_CLIENT
from controller.bus_io.message_state import MessageState, Signal, age_out
from controller.crane.nodes import NodeMonitor
from machine.joints import ARTICULATION, JOINTS
from machine.profile import Profile, encoders
from machine.status.stale_inputs import CRANE_INPUT_BITS, ENCODER_BIT

LOST_SAMPLES: Final = 3
"""An encoder behind a PLC is lost after this many of the PLC's samples, as one on the bus after as many periods."""
_OWN_MESSAGES: Final = ("Nmt", "Sync", "ValveCmdA", "ValveCmdB", "CtrlStatus", "HeartbeatCtrl")


def sample_timeout_ns(profile: Profile) -> int:
    """An encoder behind a PLC is lost after this long without a new sample; 0: no PLC, the DBC's time-out counts."""
    return 0 if profile.plc is None else LOST_SAMPLES * round(profile.plc.sample_ms * 1e6)


class CraneInputs:
    """All inputs from crane0: message states, nodes, and what this tick brought."""

    def __init__(self, database: Database, profile: Profile) -> None:
        self._by_key: dict[int, MessageState] = {}

        def state(name: str, bit: int, timeout_ns: int = 0) -> MessageState:
            codec = database.message(name)
            return self._by_key.setdefault(codec.key, MessageState(codec, bit, timeout_ns=timeout_ns))

        self.estop, self.guard, self.valve_a, self.valve_b, self.plc, *helpful = (
            state(name, bit) for name, bit in CRANE_INPUT_BITS.items()
        )
        self.pressures, self.grapple = helpful[:3], helpful[3]
        self.plc_outputs = None if profile.plc is None else state("PlcOut", CRANE_INPUT_BITS["PlcStatus"])
        """Openings that a PLC commands to the valves, None without one: part of its status, so with the same bit."""
        self.plc_states = [self.plc] if self.plc_outputs is None else [self.plc, self.plc_outputs]
        specs = encoders(profile)
        lost_ns = sample_timeout_ns(profile)
        sensed = {place: state(spec.message, ENCODER_BIT + place, lost_ns) for place, spec in specs.items()}
        self.encoders = [sensed.get(j) for j in JOINTS]
        """By joint; None where the machine has none."""
        self.articulation = sensed.get(ARTICULATION)
        self.imu = None
        """Swing of the grapple, None without the sensor.  It is optional, so it has no bit in the mask."""
        if profile.imu is not None:
            codec = database.message(profile.imu.message)
            self.imu = self._by_key.setdefault(codec.key, MessageState(codec, 0, watched=False))
        self._masked = tuple(s for s in self._by_key.values() if s is not self.imu)
        self.needed = [self.estop, self.guard, self.valve_a, self.valve_b, *self.plc_states, *sensed.values()]
        self.nodes = NodeMonitor([spec.node for spec in specs.values()])
        self._own = frozenset(database.message(name).key for name in _OWN_MESSAGES)
        self.messages = tuple(self._by_key.values())
        self.stale_mask = age_out(self._masked, 0)
        self.foreign = False
        """Another node sent one of the controller's own frames in this tick."""
        self.heard_ns = 0
        """When the newest frame came, whatever it was."""
        self.unknown = self.count = 0

    def filters(self) -> list[int]:
        """Keys to receive, for the bus's filter; the controller's own are among them, to notice a foreign sender."""
        services = (EMCY_BASE, SDO_TO_CLIENT, HEARTBEAT_BASE)
        return [*self._by_key, *self._own, *(base + node for base in services for node in self.nodes.by_number)]

    def forget(self) -> None:
        """All values are unknown again, as after a time without reception."""
        for state in self.messages:
            state.forget()
        self.nodes.forget()

    def decode(self, frames: list[Frame], now_ns: int, sdo: Callable[[int, bytes], bool]) -> None:
        """Decode the frames of a tick in bus order; ``sdo(key, data)`` is True for an SDO answer that it used."""
        self.foreign = False
        for state in self.messages:
            state.fresh = False
        nodes = self.nodes
        nodes.begin_tick()
        by_key, own = self._by_key, self._own
        for frame in frames:
            key = frame[1]
            found = by_key.get(key)
            if found is not None:
                found.receive(frame, now_ns)
            elif key in own:
                self.foreign = True
            elif not (nodes.receive(frame, now_ns) or sdo(key, frame[2])):
                self.unknown += 1
        self.count += len(frames)
        if frames:
            self.heard_ns = min(frames[-1][0], now_ns)
        self.stale_mask = age_out(self._masked, now_ns)
        if self.imu is not None:
            age_out((self.imu,), now_ns)


def spool_signals(inputs: CraneInputs) -> list[Signal]:
    """Positions of the spools [%], in ``Joint`` order: measured, or as a PLC reports its outputs to them; without a
    value where neither is known.
    """
    outputs = inputs.plc_outputs
    if outputs is not None:
        return [Signal(outputs, joint.name.capitalize()) for joint in JOINTS]
    names = ("SpoolSlew", "SpoolLift", "SpoolTilt", "SpoolExt")
    return [*(Signal(inputs.valve_a, name) for name in names), Signal(inputs.valve_b, "SpoolRot")]
