"""What crane0 brings: frames to slots by key, what the nodes say of themselves, and whether another speaks for us.

Only the newest values are kept.  Frames of nodes (heartbeat, emergency) and SDO answers are told apart by key; the
rest is counted as unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from can_dbc.canopen import EMCY_BASE, HEARTBEAT_BASE, SDO_TO_CLIENT
from can_dbc.codec import Database
from can_dbc.frame import Frame
from controller.message_state import Slot, age_out
from controller.nodes import Nodes
from machine.joints import ARTICULATION, JOINTS
from machine.profile import Profile, encoders
from machine.reasons import ENCODER_BIT

BITS: Final = {
    "EstopStat": 0, "GuardStat": 1, "ValveFbA": 8, "ValveFbB": 9, "PlcStatus": 10,
    "PressA": 11, "PressB": 12, "PressC": 13, "GrappleStat": 14,
}  # fmt: skip
"""Bits of the stale mask; for the encoders see ``ENCODER_BIT``, for mach0 `controller.carrier.inputs`."""

_OWN_MESSAGES: Final = ("Nmt", "Sync", "ValveCmdA", "ValveCmdB", "CtrlStatus", "HeartbeatCtrl")


class Received:
    """All inputs from crane0: slots, nodes, and what this tick brought."""

    def __init__(self, database: Database, profile: Profile) -> None:
        self._slots: dict[int, Slot] = {}

        def slot(name: str, bit: int) -> Slot:
            codec = database.message(name)
            return self._slots.setdefault(codec.key, Slot(codec, bit))

        self.estop, self.guard, self.valve_a, self.valve_b, self.plc, *helpful = (
            slot(name, bit) for name, bit in BITS.items()
        )
        self.pressures, self.grapple = helpful[:3], helpful[3]
        specs = encoders(profile)
        sensed = {place: slot(spec.message, ENCODER_BIT + place) for place, spec in specs.items()}
        self.encoders = [sensed.get(j) for j in JOINTS]
        """By joint; None where the machine has none."""
        self.articulation = sensed.get(ARTICULATION)
        self.imu = None
        """Swing of the grapple; a help, so it has no place in the mask.  None where the machine has no sensor."""
        if profile.imu is not None:
            codec = database.message(profile.imu.message)
            self.imu = self._slots.setdefault(codec.key, Slot(codec, 0, watched=False))
        self._judged = tuple(slot for slot in self._slots.values() if slot is not self.imu)
        self.needed = [self.estop, self.guard, self.valve_a, self.valve_b, self.plc, *sensed.values()]
        self.nodes = Nodes([spec.node for spec in specs.values()])
        self._own = frozenset(database.message(name).key for name in _OWN_MESSAGES)
        self.slots = tuple(self._slots.values())
        self.stale_mask = age_out(self._judged, 0)
        self.foreign = False
        """One of our own frames came from elsewhere this tick."""
        self.unknown = self.count = 0

    def wanted(self) -> list[int]:
        """Keys of all that is looked at, for the bus to filter by; our own are among them, to notice another who
        speaks for us.
        """
        services = (EMCY_BASE, SDO_TO_CLIENT, HEARTBEAT_BASE)
        return [*self._slots, *self._own, *(base + node for base in services for node in self.nodes.by_number)]

    def forget(self) -> None:
        """Everything is unknown again, as after a time in which nothing could be heard."""
        for slot in self.slots:
            slot.forget()
        self.nodes.forget()

    def read(self, frames: list[Frame], now_ns: int, sdo: Callable[[int, bytes], bool]) -> None:
        """Takes the frames of a tick in bus order; ``sdo(key, data)`` says whether it wanted a frame."""
        self.foreign = False
        for slot in self.slots:
            slot.fresh = False
        nodes = self.nodes
        nodes.begin()
        find, own = self._slots.get, self._own
        for frame in frames:
            key = frame[1]
            known = find(key)
            if known is not None:
                known.take(frame, now_ns)
            elif key in own:
                self.foreign = True
            elif not (nodes.receive(frame, now_ns) or sdo(key, frame[2])):
                self.unknown += 1
        self.count += len(frames)
        self.stale_mask = age_out(self._judged, now_ns)
        if self.imu is not None:
            age_out((self.imu,), now_ns)
