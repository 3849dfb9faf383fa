"""Tick records: inputs and outputs of a tick to bytes, and back to inputs for a replay.

A record holds all of `Inputs` and `Outputs`, except mode and reason, which follow from the rest.
"""

from __future__ import annotations

from dataclasses import replace

from can_dbc.frame import RawFrame
from can_dbc.messages.tick_record import RecordWriter, TickRecord
from controller.tick import Inputs, Outputs


def write(writer: RecordWriter, inputs: Inputs, outputs: Outputs, now_ns: int) -> memoryview:
    """Write the record of the tick that was just run; it is valid until the writer's next one."""
    return writer.write(
        now_ns,
        inputs.late_ns,
        inputs.tick_ns,
        inputs.missed_ticks,
        inputs.bus,
        inputs.machine_bus,
        inputs.frames,
        inputs.machine_frames,
        inputs.datagrams,
        (*outputs.frames, outputs.sync),
        outputs.machine_frames,
        outputs.report or b"",
        outputs.vehicle_report or b"",
        inputs.operator,
    )


def record(inputs: Inputs, outputs: Outputs, now_ns: int) -> bytes:
    """Write the record of the tick that was just run, to keep."""
    return bytes(write(RecordWriter(), inputs, outputs, now_ns))


def restore_inputs(inputs: Inputs, tick: TickRecord) -> None:
    """Fill ``inputs`` from a recorded tick; the record is not changed."""
    inputs.frames[:], inputs.machine_frames[:] = tick.frames_in, tick.machine_frames_in
    inputs.operator[:], inputs.datagrams[:] = tick.operator, tick.datagrams
    inputs.late_ns, inputs.missed_ticks, inputs.tick_ns = tick.late_ns, tick.missed_ticks, tick.tick_ns
    inputs.bus, inputs.machine_bus = replace(tick.bus), replace(tick.machine_bus)


def transmitted(outputs: Outputs) -> tuple[tuple[RawFrame, ...], tuple[RawFrame, ...], bytes, bytes]:
    """Return what a tick transmitted: frames on crane0 with SYNC last, frames on mach0, both reports."""
    frames = (*outputs.frames, outputs.sync)
    return frames, tuple(outputs.machine_frames), outputs.report or b"", outputs.vehicle_report or b""
