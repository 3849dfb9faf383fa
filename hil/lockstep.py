"""The whole machine in one process on virtual time: controller, guard, planner, plant and recorder, real CAN bytes.

The parts are the same pure cores that the processes of a live run wrap; only the bus (`hil.wire.core`) and the clock
differ.  Time moves in slices of 2.5 ms; the bus delivers every frame at the end of its transmission time.  Nothing
here reads a clock or draws a random number, so a seed gives the same bytes every time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from autonomy.activity import Activity
from autonomy.logs import LogObservation
from can_dbc import setpoint, tick_record
from can_dbc.frame import Frame
from controller.config import Settings
from controller.guard.judge import Guard
from controller.step import Controller, Inputs, Outputs, step
from hil.operator import Operator
from hil.wire.core import WireCore
from hil.wire.inprocess import InProcessBus
from recorder.recorder import Recorder
from sim.plant import Plant

SLICE_NS: Final = 2_500_000
CRANE_BITRATE: Final = 1_000_000
START_NS: Final = 1_000_000_000
"""Virtual time of the first slice; not zero, so that a forgotten "unknown" cannot pass for a time stamp."""


@dataclass(slots=True)
class Observer:
    """What a run may be watched by; every hook is optional."""

    recorder: Recorder | None = None
    on_report: list = field(default_factory=list)


class Lockstep:
    """One crane, its controller, guard and planner on one virtual bus."""

    def __init__(
        self,
        settings: Settings,
        guard: Guard,
        plant: Plant,
        activity: Activity,
        operator: Operator,
        observer: Observer,
    ) -> None:
        self.now_ns = START_NS
        self.ticks = 0
        self.frames = 0
        self.report: setpoint.StateReport | None = None
        self.core = WireCore(CRANE_BITRATE, settings.profile.crane_bus)
        self.plant, self.activity, self.operator = plant, activity, operator
        self._observer = observer
        self._settings = settings
        self._period_ns = 1_000_000_000 // settings.rate_hz
        self._controller = Controller(settings)
        self._guard = guard
        self._inputs = Inputs()
        self._datagrams: list[bytes] = []
        self._plant_bus = InProcessBus(self.core, "plant", tx_queue=64)
        self._control_bus = InProcessBus(self.core, "controller")
        self._guard_bus = InProcessBus(self.core, "guard")
        self._listener = InProcessBus(self.core, "recorder")
        self._next_tick_ns = START_NS

    def advance(self) -> None:
        """Move the whole system one slice on."""
        self.now_ns += SLICE_NS
        self.core.advance(self.now_ns)
        self._record_bus()
        name = self.core.name
        for _, key, data in self.plant.step(self.now_ns, [(name, f) for f in _drained(self._plant_bus)]):
            self._plant_bus.send(key, data)
        if self.now_ns >= self._next_tick_ns:
            self._next_tick_ns = self.now_ns + self._period_ns
            self._tick()

    def _tick(self) -> None:
        for key, data in self._guard.step(self.now_ns, _drained(self._guard_bus)):
            self._guard_bus.send(key, data)
        inputs = self._inputs
        inputs.frames.clear()
        self._control_bus.drain(inputs.frames)
        inputs.datagrams[:] = self._datagrams
        self._datagrams.clear()
        stats = self._control_bus.stats
        inputs.bus_state, inputs.bus_dropped = int(stats.state), stats.dropped
        inputs.bus_refused, inputs.bus_errors = stats.refused, stats.error_frames
        outputs = step(self._controller, inputs, self.now_ns)
        self.ticks += 1
        self.frames += len(inputs.frames)
        for key, data in outputs.frames:
            self._control_bus.send(key, data)
        if self._observer.recorder:
            self._observer.recorder.on_tick(_record(inputs, outputs, self.now_ns))
        report = None
        if outputs.report is not None:
            message = setpoint.decode(outputs.report, self._settings.key)
            assert isinstance(message, setpoint.StateReport)
            report = self.report = message
            if self._observer.recorder:
                self._observer.recorder.on_report(outputs.report)
            for hook in self._observer.on_report:
                hook(report)
            if press := self.operator.step(report):
                self._datagrams.append(press)
        if asked := self.activity.step(self.now_ns, report, self._look()):
            self._datagrams.append(asked)

    def _look(self) -> tuple[LogObservation, ...]:
        """The perfect detector: what lies where, as the plant knows it, four times a second."""
        if self.ticks % (self._settings.rate_hz // 4):
            return ()
        return tuple(
            LogObservation(i, log.position_m, log.axis, log.length_m, log.diameter_m)
            for i, log in enumerate(self.plant.logs())
        )

    def _record_bus(self) -> None:
        frames = _drained(self._listener)
        if self._observer.recorder:
            for frame in frames:
                self._observer.recorder.on_frame(self.core.name, frame)


def _drained(bus: InProcessBus) -> list[Frame]:
    frames: list[Frame] = []
    bus.drain(frames)
    return frames


def _record(inputs: Inputs, outputs: Outputs, now_ns: int) -> bytes:
    bus = (inputs.bus_state, inputs.bus_dropped, inputs.bus_refused, inputs.bus_errors)
    return tick_record.encode(
        now_ns, 0, 0, 0, bus, inputs.frames, inputs.datagrams, outputs.frames, outputs.report
    )  # fmt: skip
