"""A tick as the record keeps it, and back again: who runs `step` records with this, a replay feeds it with this.

Whatever `Inputs` and `Outputs` hold is in the record, but for what follows from it (mode and reason).
"""

from __future__ import annotations

from dataclasses import replace

from can_dbc import tick_record
from can_dbc.canopen import Wire
from can_dbc.tick_record import TickRecord
from controller.step import Inputs, Outputs


def record(inputs: Inputs, outputs: Outputs, now_ns: int) -> bytes:
    """The record of the tick that was just run."""
    frames, machine_frames, report, vehicle_report = said(outputs)
    return tick_record.encode(
        TickRecord(
            now_ns, inputs.late_ns, inputs.tick_ns, inputs.missed_ticks, inputs.bus, inputs.machine_bus,
            inputs.frames, inputs.machine_frames, inputs.datagrams, frames, machine_frames, report,
            vehicle_report,
        )
    )  # fmt: skip


def refill(inputs: Inputs, tick: TickRecord) -> None:
    """Gives the inputs of a recorded tick; the record is left as it is."""
    inputs.frames[:], inputs.machine_frames[:] = tick.frames_in, tick.machine_frames_in
    inputs.datagrams[:] = tick.datagrams
    inputs.late_ns, inputs.missed_ticks, inputs.tick_ns = tick.late_ns, tick.missed_ticks, tick.tick_ns
    inputs.bus, inputs.machine_bus = replace(tick.bus), replace(tick.machine_bus)


def said(outputs: Outputs) -> tuple[tuple[Wire, ...], tuple[Wire, ...], bytes, bytes]:
    """What a tick gave to the world: frames on crane0 with SYNC last, frames on mach0, both reports."""
    frames = (*outputs.frames, outputs.sync)
    return frames, tuple(outputs.machine_frames), outputs.report or b"", outputs.vehicle_report or b""
