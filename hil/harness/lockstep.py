"""The whole machine in one process on virtual time: controller, guard, planner, plant and recorder, real CAN bytes.

The parts are the pure cores that the processes of a live run wrap; only the buses (`hil.wire.core`) and the clock
differ.  Time moves in slices of 1.25 ms; a bus delivers every frame at the end of its transmission time.  SYNC leaves
one lead before each tick, so that the encoders' answers have arrived when the tick begins.  Nothing here reads a clock
or draws a random number, so a seed gives the same bytes every time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from autonomy.perception.log_list import LogObservation
from can_dbc.frame import Frame, RawFrame
from can_dbc.messages import datagrams
from can_dbc.messages.crane import StateReport
from can_dbc.messages.vehicle import VehicleReport
from controller.config import Settings
from controller.guard.__main__ import split
from controller.guard.guard import Guard
from controller.guard.operator import action_of
from controller.process.bus_link import BusLink
from controller.process.tick_recording import record
from controller.step import Controller, step
from controller.tick import Inputs, Outputs
from hil.harness.operator import Operator
from hil.wire.core import CRANE_BITRATE, MACHINE_BITRATE, WireCore
from hil.wire.inprocess import InProcessBus
from recorder.recorder import Recorder
from sim.instruments import detect
from sim.plant import Plant

SLICE_NS: Final = 1_250_000
"""Half the SYNC lead at 200 Hz: the plant receives SYNC in one slice, and its answers cross the bus in the next."""
START_NS: Final = 1_000_000_000
"""Virtual time of the first slice; not zero, because a zero stamp means unknown."""


class Planner(Protocol):
    """The source of setpoints; `autonomy.crane_job.activity.Activity` is one."""

    def step(
        self, now_ns: int, report: StateReport | None, logs: tuple[LogObservation, ...] | None
    ) -> bytes | list[bytes] | None:
        """Return the datagrams to send now; None for none.  Report and logs are None when nothing arrived."""


class LogDetector(Protocol):
    """The source of log observations; `autonomy.perception.log_detector.LogDetector` is one."""

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...] | None:
        """Return the logs detected with the joints at ``q`` [rad, m]; None when there is nothing new."""


class Disturbance(Protocol):
    """What disturbs a run at its edges; `hil.faults.injector` is one."""

    def begin(self, now_ns: int) -> None:
        """Begin and end what is due now, before the slice."""

    def datagrams(self, now_ns: int, sent: list[bytes]) -> list[bytes]:
        """Return the datagrams of the planner that reach the controller in this tick."""

    def stalled(self, process: str, now_ns: int) -> bool:
        """Tell whether a process (controller, guard, planner) does not run now."""

    def late_ns(self, now_ns: int) -> int:
        """Tell how late the controller wakes for the tick of now."""


@dataclass(slots=True)
class Observer:
    """Recorder and hooks of a run; all of them are optional."""

    recorder: Recorder | None = None
    on_report: list[Callable[[StateReport], None]] = field(default_factory=list)
    on_vehicle: list[Callable[[VehicleReport], None]] = field(default_factory=list)
    on_outputs: list[Callable[[Outputs, int], None]] = field(default_factory=list)
    """Called with the outputs and the time of every tick."""


class Lockstep:
    """One machine, its controller, guard and planner on virtual buses: crane0, and mach0 where the profile has one.

    Without ``detector`` the planner gets the true poses of the logs.
    """

    def __init__(
        self,
        settings: Settings,
        guard: Guard,
        plant: Plant,
        activity: Planner,
        operator: Operator,
        observer: Observer,
        detector: LogDetector | None = None,
    ) -> None:
        profile = settings.profile
        self.now_ns = START_NS
        self.ticks = 0
        self.frames = 0
        self.report: StateReport | None = None
        self.vehicle_report: VehicleReport | None = None
        self.logs: tuple[LogObservation, ...] = ()
        """The last list of logs that was not empty."""
        self.plant, self.activity, self.operator = plant, activity, operator
        self.disturbance: Disturbance | None = None
        self._detector = detector
        self.core = WireCore(CRANE_BITRATE, profile.crane_bus)
        self.cores = [self.core]
        if profile.machine_bus is not None:
            self.cores.append(WireCore(MACHINE_BITRATE, profile.machine_bus))
        self._observer = observer
        self._settings = settings
        self._period_ns = 1_000_000_000 // settings.rate_hz
        self._sync_lead_ns = settings.sync_lead_ns
        self._controller = Controller(settings)
        self._guard = guard
        self._inputs = Inputs()
        self._pressed: list[bytes] = []
        """The operator's commands on their way, as ``_datagrams`` are the planner's."""
        self._datagrams: list[bytes] = []
        self._plant_buses = {core.name: InProcessBus(core, "plant", tx_queue=64) for core in self.cores}
        self._crane, *more = (
            BusLink(InProcessBus(core, "controller", tx_queue=queue))
            for core, queue in zip(self.cores, settings.tx_queue_frames, strict=False)
        )
        self._machine = more[0] if self._controller.carrier_bus and more else None
        keys = guard.keys_of_buses
        self._guard_buses = [InProcessBus(c, "guard", filters=k) for c, k in zip(self.cores, keys, strict=False)]
        self._listeners = [InProcessBus(core, "recorder") for core in self.cores]
        self._next_tick_ns = START_NS
        self._sync: RawFrame | None = None

    @property
    def controller(self) -> Controller:
        """The controller."""
        return self._controller

    @property
    def guard(self) -> Guard:
        """The guard."""
        return self._guard

    @property
    def observer(self) -> Observer:
        """Recorder and hooks, to add to."""
        return self._observer

    @property
    def next_tick_ns(self) -> int:
        """Time of the next tick."""
        return self._next_tick_ns

    @property
    def period_ns(self) -> int:
        """The tick period."""
        return self._period_ns

    def press(self, command: bytes) -> None:
        """Hand an operator's command, a datagram, to the next tick of the controller."""
        self._pressed.append(command)

    def advance(self) -> None:
        """Advance the whole system by one slice."""
        self.now_ns += SLICE_NS
        if self.disturbance is not None:
            self.disturbance.begin(self.now_ns)
        for core in self.cores:
            core.advance(self.now_ns)
        self._record_buses()
        received = [(name, frame) for name, bus in self._plant_buses.items() for frame in _drained(bus)]
        for name, key, data in self.plant.step(self.now_ns, received):
            self._plant_buses[name].send(key, data)
        if self._sync is not None and self.now_ns >= self._next_tick_ns - self._sync_lead_ns:
            self._crane.bus.send(*self._sync)
            self._sync = None
        if self.now_ns >= self._next_tick_ns:
            self._next_tick_ns = self.now_ns + self._period_ns
            self._tick()

    def _tick(self) -> None:
        disturbance = self.disturbance
        if disturbance is None or not disturbance.stalled("guard", self.now_ns):
            heard = [frame for bus in self._guard_buses for frame in _drained(bus)]
            for command in self._pressed:
                action, _ = action_of(command, 0, self.now_ns)
                self._guard.hear(action, self.now_ns)
            for bus, frames in zip(self._guard_buses, split(self._guard.step(self.now_ns, heard)), strict=False):
                bus.send_all(frames)
        if disturbance is not None:
            if disturbance.stalled("controller", self.now_ns):
                return
            self._inputs.late_ns = disturbance.late_ns(self.now_ns)
            self._datagrams = disturbance.datagrams(self.now_ns, self._datagrams)
        inputs, machine = self._inputs, self._machine
        self._crane.receive(inputs.frames, inputs.bus)
        if machine is not None:
            machine.receive(inputs.machine_frames, inputs.machine_bus)
        inputs.operator[:], inputs.datagrams[:] = self._pressed, self._datagrams
        self._pressed.clear()
        self._datagrams.clear()
        outputs = step(self._controller, inputs, self.now_ns)
        for output_hook in self._observer.on_outputs:
            output_hook(outputs, self.now_ns)
        self.ticks += 1
        self.frames += len(inputs.frames) + len(inputs.machine_frames)
        self._crane.send(outputs.frames)
        if machine is not None:
            machine.send(outputs.machine_frames)
        self._sync = outputs.sync
        if self._observer.recorder:
            self._observer.recorder.on_tick(record(inputs, outputs, self.now_ns))
        report = None
        if outputs.report is not None:
            message = datagrams.decode(outputs.report)
            assert isinstance(message, StateReport)
            report = self.report = message
            if self._observer.recorder:
                self._observer.recorder.on_report(outputs.report)
            for hook in self._observer.on_report:
                hook(report)
            if press := self.operator.step(report):
                self._pressed.append(press)
        if outputs.vehicle_report is not None:
            vehicle = datagrams.decode(outputs.vehicle_report)
            assert isinstance(vehicle, VehicleReport)
            self.vehicle_report = vehicle
            if self._observer.recorder:
                self._observer.recorder.on_report(outputs.vehicle_report)
            for vehicle_hook in self._observer.on_vehicle:
                vehicle_hook(vehicle)
        if disturbance is not None and disturbance.stalled("planner", self.now_ns):
            return
        requests = self.activity.step(self.now_ns, report, self._detect())
        if requests:
            self._datagrams.extend([requests] if isinstance(requests, bytes) else requests)

    def _detect(self) -> tuple[LogObservation, ...] | None:
        """Return the logs, four times per second: detected by a camera, or their true poses; None at other times."""
        if self.ticks % (self._settings.rate_hz // 4):
            return None
        if self._detector is None:
            detected_logs: tuple[LogObservation, ...] | None = true_logs(self.plant)
        else:
            detected_logs = self._detector.detect(self.report.position, self.now_ns) if self.report else None
        self.logs = detected_logs or self.logs
        return detected_logs

    def _record_buses(self) -> None:
        recorder = self._observer.recorder
        for bus in self._listeners:
            frames = _drained(bus)
            if recorder:
                for frame in frames:
                    recorder.on_frame(bus.name, frame)


def true_logs(plant: Plant) -> tuple[LogObservation, ...]:
    """Return the logs of a plant as they truly are."""
    return tuple(
        LogObservation(i, log.position_m, log.axis, log.length_m, log.diameter_m) for i, log in enumerate(detect(plant))
    )


def _drained(bus: InProcessBus) -> list[Frame]:
    frames: list[Frame] = []
    bus.drain(frames)
    return frames
