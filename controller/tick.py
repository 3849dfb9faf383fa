"""Inputs and outputs of one tick."""

from __future__ import annotations

from dataclasses import dataclass, field

from can_dbc.frame import Frame, RawFrame
from can_dbc.messages.tick_record import BusReading
from can_dbc.protocols.canopen import sync_frame
from machine.status.modes import Mode
from machine.status.reasons import Reason


@dataclass(slots=True)
class Inputs:
    """Inputs of one tick; the caller keeps one object and refills it.  Counters are totals since the start.

    ``frames`` and ``bus`` are from crane0.  ``machine_frames`` and ``machine_bus`` are from mach0 and stay empty on a
    machine without a carrier.
    """

    frames: list[Frame] = field(default_factory=list)
    machine_frames: list[Frame] = field(default_factory=list)
    bus: BusReading = field(default_factory=BusReading)
    machine_bus: BusReading = field(default_factory=BusReading)
    operator: list[bytes] = field(default_factory=list)
    """Datagrams of persons who may arm (`controller.process.operator_socket`); they are heard before the others."""
    datagrams: list[bytes] = field(default_factory=list)
    """Datagrams of anyone else: setpoints, and STOP."""
    late_ns: int = 0
    missed_ticks: int = 0
    tick_ns: int = 0
    """Duration of the previous tick."""


@dataclass(slots=True)
class Outputs:
    """Outputs of one tick, valid until the next `step`.

    ``frames`` go out at once on crane0, ``machine_frames`` on mach0.  ``sync`` goes out on crane0 one SYNC lead before
    the next tick, so that the encoders' samples are in when that tick begins and are no older than the lead.
    """

    frames: list[RawFrame] = field(default_factory=list)
    machine_frames: list[RawFrame] = field(default_factory=list)
    sync: RawFrame = field(default_factory=lambda: sync_frame(1))
    report: bytes | None = None
    vehicle_report: bytes | None = None
    mode: Mode = Mode.BOOT
    reason: Reason = Reason.NONE
    detail: int = 0
