"""Received values of mach0: carrier, swing arms, engine (``machine.dbc``), GNSS receiver (``gnss.dbc``), addresses.

The machine's own frames are matched by identifier and carry an E2E header; the PGNs of J1939 and NMEA 2000 are matched
whatever their priority and source address.  A position with its quality is a fast packet of 7 frames.  Without the
carrier's own frames the machine stops; the loss of engine or GNSS is only reported.
"""

from __future__ import annotations

from typing import Final

from can_dbc.dbc.codec import PDU2_MASK, Database, FrameRefused, pgn_key
from can_dbc.frame import EXTENDED, Frame
from can_dbc.protocols.nmea2000 import Reassembler
from controller.bus_io import MessageState, age_out
from controller.carrier.address_claim import FORMATS, AddressClaim
from machine.status.stale_inputs import CARRIER_BIT

_NEEDED: Final = ("VehStat", "ArmHeightA", "ArmHeightB")
_ENGINE: Final = "EEC1"
_GNSS: Final = ("PositionRapidUpdate", "VesselHeading", "RateOfTurn", "CogSogRapidUpdate", "GnssPositionData")
_OWN_MESSAGES: Final = ("VehCmd", "ArmCmdA", "ArmCmdB", "CtrlAlive")


class CarrierInputs:
    """All inputs from mach0, and what this tick brought."""

    def __init__(self, machine: Database, gnss: Database) -> None:
        self.address = AddressClaim(machine)
        self.vehicle, self.arms_a, self.arms_b = needed = tuple(
            MessageState(machine.message(name), CARRIER_BIT, machine=True) for name in _NEEDED
        )
        helpful = [MessageState(machine.message(_ENGINE), CARRIER_BIT, watched=False, machine=True)]
        helpful += [MessageState(gnss.message(name), CARRIER_BIT, watched=False, machine=True) for name in _GNSS]
        self.engine, self.position, self.heading, self.rate_of_turn, self.course, self.fix = helpful
        self.needed = needed
        self._helpful = tuple(helpful)
        self.messages = (*needed, *helpful)
        self._by_key = {s.codec.key: s for s in self.messages if not s.codec.by_pgn}
        self._by_pgn = {pgn_key(s.codec.key): s for s in self.messages if s.codec.by_pgn}
        self._own = frozenset(machine.message(name).key for name in _OWN_MESSAGES)
        self._reassembler = Reassembler()
        self.stale_mask = age_out(self.messages, 0)
        self.foreign = False
        """Another node sent one of the controller's own frames in this tick."""
        self.heard_ns = 0
        """When the newest frame came, whatever it was."""
        self.unknown = self.count = 0

    def filters(self) -> list[int | tuple[int, int]]:
        """Keys to receive, for the bus's filter, with masks where the source address does not matter."""
        by_pgn = [(key, PDU2_MASK) for key in self._by_pgn]
        addresses = [(EXTENDED | form << 16, EXTENDED | 0xFF << 16) for form in FORMATS]
        return [*self._by_key, *self._own, *by_pgn, *addresses]

    def forget(self) -> None:
        """All values are unknown again, and the address must be claimed anew."""
        for state in self.messages:
            state.forget()
        self._reassembler = Reassembler()
        self.address.restart()

    def decode(self, frames: list[Frame], now_ns: int) -> None:
        """Decode the frames of a tick in bus order."""
        self.foreign = False
        for state in self.messages:
            state.fresh = False
        by_key, by_pgn = self._by_key, self._by_pgn
        for frame in frames:
            key = frame[1]
            found = by_key.get(key)
            if found is not None:
                found.receive(frame, now_ns)
                continue
            found = by_pgn.get(key & PDU2_MASK)
            if found is not None:
                if found.codec.length > 8:
                    self._receive_part(found, frame, now_ns)
                else:
                    found.receive(frame, now_ns)
            elif key in self._own:
                self.foreign = True
            elif key >> 16 & 0xFF in FORMATS:
                self.address.receive(frame)
            else:
                self.unknown += 1
        self.count += len(frames)
        if frames:
            self.heard_ns = min(frames[-1][0], now_ns)
        self.stale_mask = age_out(self.needed, now_ns)
        age_out(self._helpful, now_ns)

    def _receive_part(self, state: MessageState, frame: Frame, now_ns: int) -> None:
        """One frame of a fast packet; the packet may continue beyond the part that the DBC describes."""
        try:
            payload = self._reassembler.add(frame.key, frame.data, frame.stamp_ns)
        except FrameRefused:
            state.refused += 1
            return
        if payload is not None:
            state.receive(Frame(frame.stamp_ns, frame.key, payload[: state.codec.length]), now_ns)
