"""The diesel engine (source address 00h): EEC1, CCVS and DM1 in the layout of J1939-71/73.

It runs at one working speed and droops under the hydraulic load.  ``set_trouble`` puts a code into DM1.
"""

from __future__ import annotations

from can_dbc.dbc.codec import Database
from can_dbc.protocols.nmea2000 import encode, frames
from sim.nodes import Outbox
from sim.nodes.j1939 import J1939Node
from sim.nodes.messages import MS, PeriodicTimer

ADDRESS = 0x00
WORKING_RPM = 1500.0
DROOP_SHARE = 0.05  # of the speed, at full power
FULL_POWER_W = 110e3
IDLE_TORQUE_PCT = 12.0
LAG_S = 0.25
CYCLE_NS = 20 * MS
KM_H_PER_M_S = 3.6


class EngineNode(J1939Node):
    """The plant sets ``energy_j`` (hydraulic, since the start), ``speed_m_s``, ``brake``."""

    def __init__(self, machine: Database, outbox: Outbox) -> None:
        super().__init__(ADDRESS, 0, machine, outbox)
        self._eec1, self._ccvs, self._dm1 = (machine.message(n) for n in ("EEC1", "CCVS", "DM1"))
        self._fast, self._medium, self._slow = (
            PeriodicTimer(CYCLE_NS),
            PeriodicTimer(100 * MS, 10 * MS),
            PeriodicTimer(1000 * MS, 30 * MS),
        )
        self.energy_j = self.speed_m_s = 0.0
        self.brake = True
        self._last_j = self._load = 0.0
        self._trouble = (0, 0)

    def set_trouble(self, spn: int, fmi: int) -> None:
        """A suspect parameter number and failure mode, with the amber lamp; (0, 0): none."""
        self._trouble = (spn, fmi)

    def cycle(self, now_ns: int) -> None:
        if self._fast.due(now_ns):
            power_w = (self.energy_j - self._last_j) / (CYCLE_NS * 1e-9)
            self._last_j = self.energy_j
            self._load += CYCLE_NS * 1e-9 / LAG_S * (min(1.0, max(0.0, power_w / FULL_POWER_W)) - self._load)
            torque = IDLE_TORQUE_PCT + (100.0 - IDLE_TORQUE_PCT) * self._load
            payload = encode(
                self._eec1,
                TorqueMode=1,
                ActualTorqueFine=0,
                DemandTorque=torque,
                ActualTorque=torque,
                EngineSpeed=WORKING_RPM * (1.0 - DROOP_SHARE * self._load),
                SourceAddress=ADDRESS,
                StarterMode=0,
                Reserved=0xF,
                EngineDemandTorque=torque,
            )
            self.outbox += frames(self._eec1, payload, ADDRESS)
        if self._medium.due(now_ns):
            speed = KM_H_PER_M_S * abs(self.speed_m_s)
            brake = int(self.brake)
            payload = encode(
                self._ccvs, WheelSpeed=speed, BrakeSwitch=brake, ParkingBrake=int(self.brake and speed < 0.1)
            )
            self.outbox += frames(self._ccvs, payload, ADDRESS)
        if self._slow.due(now_ns):
            spn, fmi = self._trouble
            lamps = dict.fromkeys(("ProtectLamp", "RedLamp", "MalfunctionLamp"), 0)
            code = {
                "SpnLow": spn & 0xFFFF,
                "SpnHigh": spn >> 16,
                "Fmi": fmi,
                "Occurrence": int(spn != 0),
                "Conversion": 0,
            }
            self.outbox += frames(self._dm1, encode(self._dm1, AmberLamp=int(spn != 0), **lamps, **code), ADDRESS)
