"""The telemetry of a forwarder's shift for one page: each state that it gets is 200 ms later than the last.

Only the sources are made up: everything from the reports on is the console's own.  The page is served as fast as it
takes the states, and stands still while ``paused``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from math import cos, pi, radians, sin
from typing import Any

import msgspec

from autonomy.perception.log_list import LogObservation
from can_dbc.bus.base import Bus
from can_dbc.dbc.codec import load
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import encode
from can_dbc.messages.mission import KnownLog, MissionReport, encode_mission
from can_dbc.messages.vehicle import Driving, VehicleReport
from can_dbc.protocols.e2e import Sender
from console import server
from console.access import Page
from console.accounts import Person
from console.console import Console
from console.timeline import HOLDING
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason, pack
from tests.can_dbc.example_mission_report import HERE, MISSION_REPORT
from tests.conftest import a_timing
from tests.console.state_reports import at
from tests.console.vehicle_reports import VEHICLE

PROFILE = load_profile("aoro_fc8")
HASH = profile_hash(PROFILE)
STEP_NS = 200_000_000
HOUR_NS = 3600 * 10**9
AHEAD_STEPS = 300
"""So many states may wait for the page, which answers five times a second."""
PERIOD_S = 0.02
"""Between states that are repeated."""
CYCLE_S = 40.0
"""A log: 15 s of driving, then the crane's work."""
DRIVE_S = 15.0
SPEED_M_S = 1.0
LAP_M = 300.0
STOP_EVERY = 5
"""Every so many logs the machine stops, and a person arms it again after four seconds."""
LOAD_LOGS = 12
NORTH_M_DEG, EAST_M_DEG = 111_450.0, 49_500.0
"""About, at that latitude."""
LOGS = 30
"""On the map; one is loaded and another one found."""


@dataclass
class ShiftFeed:
    """The reports of a shift by its time; ``step`` hands over those of the next 200 ms."""

    now_ns: int
    bus: Bus
    steps: int = 0
    _mission: MissionReport = MISSION_REPORT
    _driven_m: float = 0.0
    _crane: Any = field(default_factory=lambda: load("crane"))

    def __post_init__(self) -> None:
        self._began_ns = self.now_ns
        self._valve, self._lift = self._crane.message("ValveFbA"), self._crane.message("EncLift")
        self._sender = Sender(self._valve.data_ids)

    @property
    def hours(self) -> float:
        """Of the shift so far."""
        return (self.now_ns - self._began_ns) / HOUR_NS

    def step(self, console: Console) -> None:
        """The next 200 ms."""
        self.steps += 1
        self.now_ns += STEP_NS
        t = (self.now_ns - self._began_ns) * 1e-9
        cycle, into = divmod(t, CYCLE_S)
        drives, stopped = into < DRIVE_S, int(cycle) % STOP_EVERY == 0 and DRIVE_S + 5 < into < DRIVE_S + 9
        self._driven_m += SPEED_M_S * STEP_NS * 1e-9 * drives
        state = console.crane_state
        state.on_report(encode(self._crane_report(t, into, stopped)), self.now_ns)
        state.on_report(encode(self._vehicle_report(drives)), self.now_ns)
        if self.steps % 3 == 0:
            state.on_report(
                encode_mission(self._mission_report(int(cycle), drives), self.steps, HASH, self.now_ns), self.now_ns
            )
        if self.steps % 5 == 0:
            centers = [(2.0 + k, 3.0 - 0.5 * k + 0.002 * sin(t + k), -0.9) for k in range(4)]
            state.logs = tuple(
                LogObservation(int(cycle) + k, center, (0.0, 1.0, 0.0), 2.0, 0.25) for k, center in enumerate(centers)
            )
        if self.steps % 10 == 0:
            state.on_timing(a_timing(20 + self.steps % 50, written_ns=self.now_ns))
        self.bus.send(self._valve.key, self._sender.protect(bytes(self._valve.length)))
        self.bus.send(self._lift.key, self.steps.to_bytes(8, "little")[: self._lift.length])

    def _crane_report(self, t: float, into: float, stopped: bool) -> StateReport:
        work = max(0.0, into - DRIVE_S)
        q = (sin(0.25 * work), 0.9 + 0.2 * sin(0.3 * work), -1.6 + 0.2 * cos(0.3 * work), 0.5, 0.0)
        reference = tuple(v + 0.003 * sin(t) for v in q)
        holds = 12.0 < work < 20.0
        mode, reason = (Mode.STOP, pack(Reason.JOINT_STUCK, 1)) if stopped else (Mode.ACTIVE, 0)
        grip = {"opening_pct": 20.0, "clamp_bar": 120.0, "load_kg": 105.0, "grapple_state": HOLDING}
        free = {"opening_pct": 100.0, "clamp_bar": 0.0, "load_kg": 0.0, "grapple_state": 1}
        count = {"sequence": self.steps, "setpoint_sequence": self.steps, "frames_received": 11 * self.steps}
        told = (grip if holds else free) | count | {"profile_hash": HASH, "reference": reference, "reason": reason}
        return at(q, self.now_ns, mode, tick_ns=700_000, late_ns=60_000, **told)

    def _vehicle_report(self, drives: bool) -> VehicleReport:
        """Round and round a circle, a little beside the track of the lap before."""
        lap, along = divmod(self._driven_m, LAP_M)
        angle, radius = 2 * pi * along / LAP_M, LAP_M / (2 * pi) + 0.3 * (lap % 20)
        latitude, longitude = HERE[0] + radius * sin(angle) / NORTH_M_DEG, HERE[1] + radius * cos(angle) / EAST_M_DEG
        speed, driving = (SPEED_M_S, Driving.DRIVING) if drives else (0.0, Driving.STANDING)
        heading = radians(-((360.0 * along / LAP_M) % 360.0)) % (2 * pi)
        told = dict.fromkeys(("stamp_ns", "position_ns", "heading_ns", "motion_ns"), self.now_ns)
        told |= {"sequence": self.steps, "drive_sequence": self.steps, "profile_hash": HASH, "driving": driving}
        told |= {"latitude_deg": latitude, "longitude_deg": longitude, "heading_rad": heading, "speed_m_s": speed}
        return replace(VEHICLE, articulation_rad=0.1, roll_rad=0.02 * sin(angle), pitch_rad=0.0, **told)

    def _mission_report(self, loaded: int, drives: bool) -> MissionReport:
        logs = tuple(_known(loaded + k) for k in range(LOGS))
        return msgspec.structs.replace(
            self._mission,
            name="shift",
            loaded=loaded,
            on_board=loaded % LOAD_LOGS,
            missed=loaded // 9,
            unloaded=loaded - loaded % LOAD_LOGS,
            on_board_m3=round(0.1 * (loaded % LOAD_LOGS), 3),
            logs=logs,
            driven_m=round(self._driven_m, 1),
            targets=(loaded,),
            words="drives up to the log" if drives else "loads a log",
        )


@cache
def _known(number: int) -> KnownLog:
    angle = 0.37 * number
    place = (HERE[0] + 45.0 * sin(angle) / NORTH_M_DEG, HERE[1] + 45.0 * cos(angle) / EAST_M_DEG)
    return KnownLog(number, place, (37.0 * number) % 360.0, 2.0, 0.25, 0.4, 0, False)


@dataclass
class FedConsole(Console):
    """A console whose page makes the time go by; make it with ``clock=lambda: feed.now_ns`` and an ``operator``.

    With an operator's socket the page answers states (`console.console`), which tells how far it is.
    """

    feed: ShiftFeed | None = None
    paused: bool = True
    answered_ms: int = 0
    """Time of the newest state that the page has answered."""

    def state_for(self, page: Page | None, person: Person) -> dict[str, Any]:
        """The next state of the shift; the same again while paused, or when the page is too far behind."""
        assert self.feed is not None
        ahead = self.feed.now_ns - self.answered_ms * 1_000_000 > AHEAD_STEPS * STEP_NS
        server.PERIOD_S = PERIOD_S if self.paused or ahead else 0.0
        if not self.paused and not ahead:
            self.feed.step(self)
        return Console.state_for(self, page, person)

    def watch(self, answer: str, page: Page | None) -> None:
        """An answer of the page."""
        self.answered_ms = int(answer.split()[1])
        Console.watch(self, answer, page)
