"""What mach0 brings: carrier, swing arms and engine (``machine.dbc``), the GNSS receiver (``gnss.dbc``), addresses.

Own frames of the machine are matched by identifier and carry an E2E header; the PGNs of J1939 and NMEA 2000 are
matched whatever priority and source address.  A position with its quality is a fast packet of 7 frames.  Without the
carrier's own frames the machine stops; without engine or GNSS it is said.
"""

from __future__ import annotations

from typing import Final

from can_dbc.codec import PDU2_MASK, Database, FrameRefused, pgn_key
from can_dbc.frame import EXTENDED, Frame
from can_dbc.nmea2000 import Reassembler
from controller.carrier.address_claim import FORMATS, AddressClaim
from controller.message_state import Slot, age_out

STALE_BIT: Final = 15
"""In the mask of stale inputs: one of the carrier's own frames."""
_NEEDED: Final = ("VehStat", "ArmHeightA", "ArmHeightB")
_ENGINE: Final = ("EEC1", "CCVS", "DM1")
_GNSS: Final = (
    "PositionRapidUpdate", "VesselHeading", "RateOfTurn", "Attitude", "CogSogRapidUpdate", "GnssPositionData",
    "SystemTime",
)  # fmt: skip
_OWN_MESSAGES: Final = ("VehCmd", "ArmCmdA", "ArmCmdB", "CtrlAlive")


class MachineReceived:
    """All inputs from mach0, and what this tick brought."""

    def __init__(self, machine: Database, gnss: Database) -> None:
        self.address = AddressClaim(machine)
        self.vehicle, self.arms_a, self.arms_b = needed = tuple(
            Slot(machine.message(name), STALE_BIT, machine=True) for name in _NEEDED
        )
        helpful = [Slot(machine.message(name), STALE_BIT, watched=False, machine=True) for name in _ENGINE]
        helpful += [Slot(gnss.message(name), STALE_BIT, watched=False, machine=True) for name in _GNSS]
        self.engine, self.vehicle_speed, self.trouble, self.position, self.heading, *more = helpful
        self.rate_of_turn, self.attitude, self.course, self.fix, self.time = more
        self.needed = needed
        self._helpful = tuple(helpful)
        self.slots = (*needed, *helpful)
        self._by_key = {s.codec.key: s for s in self.slots if not s.codec.by_pgn}
        self._by_pgn = {pgn_key(s.codec.key): s for s in self.slots if s.codec.by_pgn}
        self._own = frozenset(machine.message(name).key for name in _OWN_MESSAGES)
        self._reassembler = Reassembler()
        self.stale_mask = age_out(self.slots, 0)
        self.foreign = False
        """One of our own frames came from elsewhere this tick."""
        self.unknown = self.count = 0

    def wanted(self) -> list[int | tuple[int, int]]:
        """Keys of all that is looked at, for the bus to filter by, with masks where the source does not matter."""
        by_pgn = [(key, PDU2_MASK) for key in self._by_pgn]
        addresses = [(EXTENDED | form << 16, EXTENDED | 0xFF << 16) for form in FORMATS]
        return [*self._by_key, *self._own, *by_pgn, *addresses]

    def forget(self) -> None:
        """Everything is unknown again, and our address is to be claimed anew."""
        for slot in self.slots:
            slot.forget()
        self._reassembler = Reassembler()
        self.address.again()

    def read(self, frames: list[Frame], now_ns: int) -> None:
        """Takes the frames of a tick in bus order."""
        self.foreign = False
        for slot in self.slots:
            slot.fresh = False
        by_key, by_pgn = self._by_key.get, self._by_pgn.get
        for frame in frames:
            key = frame[1]
            known = by_key(key)
            if known is not None:
                known.take(frame, now_ns)
                continue
            known = by_pgn(key & PDU2_MASK)
            if known is not None:
                if known.codec.length > 8:
                    self._take_part(known, frame, now_ns)
                else:
                    known.take(frame, now_ns)
            elif key in self._own:
                self.foreign = True
            elif key >> 16 & 0xFF in FORMATS:
                self.address.take(frame)
            else:
                self.unknown += 1
        self.count += len(frames)
        self.stale_mask = age_out(self.needed, now_ns)
        age_out(self._helpful, now_ns)

    def _take_part(self, slot: Slot, frame: Frame, now_ns: int) -> None:
        """One frame of a fast packet; the packet may go on behind the described part."""
        try:
            payload = self._reassembler.add(frame.key, frame.data, frame.stamp_ns)
        except FrameRefused:
            slot.refused += 1
            return
        if payload is not None:
            slot.take(Frame(frame.stamp_ns, frame.key, payload[: slot.codec.length]), now_ns)
