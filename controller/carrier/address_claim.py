"""The controller's address on mach0 (J1939-81): claimed by NAME before any other frame, defended, given up when lost.

The address is fixed, because the frames of `can_dbc/machine.dbc` carry it.  A claim of the same address by a NAME of
higher priority (a smaller number, or the same) wins it: from then on only "cannot claim" is sent, from the null
address, until a reset claims again.  Addresses below 128 need no waiting time after the claim (4.4.3.3).
"""

from __future__ import annotations

from typing import Final

from can_dbc.dbc.codec import Database
from can_dbc.frame import Frame, RawFrame
from can_dbc.protocols.nmea2000 import BROADCAST, encode, frames, split_id

ADDRESS: Final = 0x27
"""Management computer 1, in the list of preferred addresses."""
NULL_ADDRESS: Final = 254
CLAIM_PGN: Final = 60928
REQUEST_PGN: Final = 59904
FORMATS: Final = (REQUEST_PGN >> 8, CLAIM_PGN >> 8)
"""The byte of an identifier (bits 16 to 23) of frames about addresses."""
_NO_MANUFACTURER: Final = 2047
"""No code is assigned to this project."""
_MANAGEMENT_COMPUTER: Final = 30
_FORESTRY: Final = 2


class AddressClaim:
    """The claim of one address; `frame` returns the frame that is due."""

    __slots__ = ("_claim", "_due", "_name", "_request", "lost")

    def __init__(self, database: Database) -> None:
        self._claim, self._request = database.message("AddressClaim"), database.message("Request")
        self._name = encode(
            self._claim,
            IdentityNumber=1,
            ManufacturerCode=_NO_MANUFACTURER,
            EcuInstance=0,
            FunctionInstance=0,
            Function=_MANAGEMENT_COMPUTER,
            Reserved=0,
            VehicleSystem=0,
            VehicleSystemInstance=0,
            IndustryGroup=_FORESTRY,
            ArbitraryAddress=0,
        )
        self.restart()

    def restart(self) -> None:
        """Claim the address as at power-on."""
        self.lost = False
        """Another node has the address: nothing may be sent from it."""
        self._due = True

    def receive(self, frame: Frame) -> None:
        """Use a frame whose identifier has one of ``FORMATS``."""
        _, pgn, source, destination = split_id(frame.key)
        if pgn == REQUEST_PGN and len(frame.data) == self._request.length:
            wanted = int.from_bytes(frame.data, "little")
            self._due |= wanted == CLAIM_PGN and destination in (ADDRESS, BROADCAST)
        elif pgn == CLAIM_PGN and source == ADDRESS and len(frame.data) == self._claim.length:
            # The smaller NAME wins; two nodes of the same NAME cannot be distinguished, and both give up.
            theirs, ours = (int.from_bytes(name, "little") for name in (frame.data, self._name))
            self.lost |= theirs <= ours
            self._due = True

    def frame(self) -> RawFrame | None:
        """The claim when one is due: at most one per tick, however many requests came."""
        if not self._due:
            return None
        self._due = False
        return frames(self._claim, self._name, NULL_ADDRESS if self.lost else ADDRESS)[0]
