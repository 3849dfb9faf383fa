"""The base of the nodes of mach0: a fixed source address, claimed by NAME (J1939-81), and PGN-matched frames.

A node claims at power-on (PGN 60928), answers requests for its claim (PGN 59904), defends its address against a NAME
of lower priority (a greater number), and falls silent for good when it loses: it then reports so from address 254.
Addresses below 128 need no waiting time after the claim (J1939-81, 4.4.3.3).
"""

from __future__ import annotations

from can_dbc.dbc.codec import Database
from can_dbc.protocols.nmea2000 import BROADCAST, encode, frames, split_id
from sim.nodes import Outbox

CLAIM_PGN, REQUEST_PGN = 60928, 59904
ADDRESS_FORMATS = (REQUEST_PGN >> 8, CLAIM_PGN >> 8)  # the byte of the identifier that marks these two
NULL_ADDRESS = 254
NO_MANUFACTURER = 2047  # none is assigned to this project
FORESTRY, MARINE = 2, 4  # industry groups


class J1939Node:
    """One node; ``address_lost`` is set once another node has its address."""

    def __init__(
        self,
        address: int,
        function: int,
        machine: Database,
        outbox: Outbox,
        *,
        industry: int = FORESTRY,
        system: int = 0,
    ) -> None:
        self.address, self.outbox = address, outbox
        self._claim, self._request = machine.message("AddressClaim"), machine.message("Request")
        self.name = encode(
            self._claim,
            IdentityNumber=address,
            ManufacturerCode=NO_MANUFACTURER,
            EcuInstance=0,
            FunctionInstance=0,
            Function=function,
            Reserved=0,
            VehicleSystem=system,
            VehicleSystemInstance=0,
            IndustryGroup=industry,
            ArbitraryAddress=0,
        )
        self._claimed = self.address_lost = False

    def _send_claim(self) -> None:
        self.outbox += frames(self._claim, self.name, NULL_ADDRESS if self.address_lost else self.address)

    def receive(self, key: int, data: bytes, now_ns: int) -> None:
        """A frame of the bus."""
        if key >> 16 & 0xFF not in ADDRESS_FORMATS:
            return
        _, pgn, source, destination = split_id(key)
        if pgn == REQUEST_PGN:
            wanted = self._request.receive(data)[0] if len(data) == 3 else None
            if wanted == CLAIM_PGN and destination in (self.address, BROADCAST):
                self._send_claim()
        elif pgn == CLAIM_PGN and source == self.address and len(data) == 8:
            theirs, ours = (int.from_bytes(name, "little") for name in (data, self.name))
            self.address_lost = self.address_lost or theirs <= ours
            self._send_claim()

    def tick(self, now_ns: int) -> None:
        """Claim at power-on, then the periodic frames."""
        if not self._claimed:
            self._claimed = True
            self._send_claim()
        if not self.address_lost:
            self.cycle(now_ns)

    def cycle(self, now_ns: int) -> None:
        """Periodic frames of a node that has its address."""
