"""Test bench for the controller: emulated nodes and a simple crane, in virtual time, in one process.

The bench answers SDO like an encoder, sends every input frame at its period with a valid E2E header, and turns spool
commands into joint motion through dead time, lag and dead-band.  A machine with a carrier (`AORO`) has mach0 as well.
Faults are injected by name: ``dropped`` messages, ``changed`` signals, ``corrupt`` messages.
"""

from __future__ import annotations

import gc
import math
import random
import tracemalloc
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Literal

import msgspec

from can_dbc.dbc.codec import load
from can_dbc.frame import Frame
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, OperatorAction, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import is_operator_command
from can_dbc.messages.vehicle import VehicleReport
from can_dbc.protocols.canopen import (
    SDO_TO_CLIENT,
    SdoKind,
    abort_frame,
    download_response,
    heartbeat_frame,
    parse_request,
    upload_response,
)
from can_dbc.protocols.e2e import Sender
from can_dbc.protocols.nmea2000 import frames as packet
from controller.config import Settings
from controller.config import load as load_settings
from controller.guard.__main__ import split
from controller.guard.operator import action_of
from controller.laws.valve_map import ValveMap
from controller.step import Controller, step
from controller.tick import Inputs, Outputs
from machine.joints import JOINTS, N_JOINTS
from machine.loading.profile_file import profile_hash
from machine.profile import Plc, Profile, encoders, joint
from machine.sensing import counts_from_position
from machine.status.modes import Mode
from machine.status.reasons import Reason

DATABASE = load("crane")
MACHINE, GNSS = load("machine"), load("gnss")
CODECS = {**DATABASE.messages, **MACHINE.messages, **GNSS.messages}
AORO = load_settings("aoro_fc8")
SETTINGS = load_settings("palms_471")
PROFILE = SETTINGS.profile
SPECS = [joint(PROFILE, j) for j in JOINTS]
T = SETTINGS.period_ns
OTHER_CHECK = SETTINGS.file_check ^ 1
"""GuardStat.ProfileCheck of a guard with another profile."""
MS = 1_000_000
HOME = (0.0, 0.5, -1.2, 0.6, 0.0)
PERIOD_MS = {"EstopStat": 10, "GuardStat": 10, "PressC": 20, "GrappleStat": 20, "PlcStatus": 20, "PlcOut": 10}
VALUES: dict[str, dict[str, float]] = {
    "EstopStat": {"ChannelA": 1, "ChannelB": 1, "PilotSupply": 1, "PilotPress": 30.0},
    "GuardStat": {"Enable": 0xA},
    "ValveFbA": {},
    "ValveFbB": {},
    "PressA": {},
    "PressB": {},
    "PressC": {"Pump": 180.0},
    "PlcStatus": {"Mode": 2},
    "PlcOut": {},
    "GrappleStat": {"Opening": 100.0},
}
MACHINE_PERIOD_MS = {
    "VehStat": 20,
    "ArmHeightA": 20,
    "ArmHeightB": 20,
    "EEC1": 20,
    "CCVS": 100,
    "DM1": 1000,
    "PositionRapidUpdate": 100,
    "VesselHeading": 100,
    "RateOfTurn": 100,
    "Attitude": 100,
    "CogSogRapidUpdate": 250,
    "GnssPositionData": 1000,
    "SystemTime": 1000,
}
MACHINE_VALUES: dict[str, dict[str, float]] = {
    "VehStat": {"Gear": 3, "Brake": 1, "ParkBrake": 1},
    "EEC1": {"EngineSpeed": 1500.0},
    "PositionRapidUpdate": {"Latitude": 63.66, "Longitude": 19.9},
    "VesselHeading": {"Heading": 1.0},
    "GnssPositionData": {"Method": 4},
}
SOURCES = {"GNSS": 0x1C, "ENGINE": 0x00}


def count_until(tick: Callable[[], Any], done: Callable[[], bool], limit: int = 100) -> int:
    """Number of ticks until ``done``; fails after ``limit`` ticks."""
    for k in range(1, limit + 1):
        tick()
        if done():
            return k
    raise AssertionError(f"not after {limit} ticks")


def settings_of(profile: Profile) -> Settings:
    """The settings of a changed profile."""
    return Settings(profile, profile_hash(profile), profile.rate_hz)


def behind_plc(role: Literal["references", "valves"]) -> Settings:
    """The settings of a crane whose valves a PLC drives."""
    return settings_of(msgspec.structs.replace(PROFILE, plc=Plc(role)))


def with_pump(flow_m3_s: float) -> Profile:
    """The profile of a crane with another pump."""
    hydraulics = msgspec.structs.replace(PROFILE.hydraulics, pump_flow_m3_s=flow_m3_s)
    return msgspec.structs.replace(PROFILE, hydraulics=hydraulics)


def bytes_kept(ticks: Callable[[int], None], count: int) -> int:
    """Of several windows of ``count`` ticks the least that one keeps; fails for reference cycles.

    What a tick keeps shows in every window; what other threads of the test run keep, in one.
    """
    ticks(200)
    gc.collect()
    tracemalloc.start(1)
    ticks(200)
    gc.collect()  # also empties the interpreter's free lists, which count as memory
    kept = []
    for _ in range(3):
        before, _ = tracemalloc.get_traced_memory()
        ticks(count)
        gc.collect()
        kept.append(tracemalloc.get_traced_memory()[0] - before)
    tracemalloc.stop()
    gc.disable()
    try:
        ticks(200)
        assert gc.collect() == 0, "a tick must not make reference cycles"
    finally:
        gc.enable()
    return min(kept)


class EncoderNode:
    """An encoder's object dictionary and NMT state."""

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.state = 0x7F
        self.objects = {
            (0x1000, 0): spec.device_type,
            (0x1018, 1): 7,
            (0x6001, 0): spec.total_counts,
            (0x6005, 1): round(spec.unit_per_count * 1e9),
            (0x6002, 0): spec.total_counts,
            (0x1A00, 0): 2,
            (0x6000, 0): 4,
            (0x6003, 0): 0,
            (0x6509, 0): 0,
        }
        self.silent = False
        self.refuses: set[tuple[int, int]] = set()
        self.writes: list[tuple[int, int, int]] = []

    def answer(self, key: int, data: bytes) -> tuple[int, bytes] | None:
        request = parse_request(key, data)
        if request is None or request.node != self.spec.node or self.silent:
            return None
        place = (request.index, request.sub)
        if place in self.refuses or (request.kind is SdoKind.UPLOAD and place not in self.objects):
            return abort_frame(SDO_TO_CLIENT, request.node, *place, 0x06020000)
        if request.kind is SdoKind.UPLOAD:
            return upload_response(request.node, *place, self.objects[place].to_bytes(4, "little"))
        self.objects[place] = request.unsigned
        self.writes.append((*place, request.unsigned))
        return download_response(request.node, *place)


class Bench:
    """A controller and its environment; `tick` advances both by one period."""

    def __init__(self, settings=SETTINGS, start_ns: int = 1_000_000_000, home=HOME, guard=None) -> None:
        self.settings = settings
        self.guard = guard
        self.controller = Controller(settings, DATABASE, (MACHINE, GNSS))
        self.inputs = Inputs()
        self.now_ns = start_ns
        self.count = 0
        self.q = list(home)
        self.v = [0.0] * N_JOINTS
        self.stuck: set[int] = set()
        self.backward: set[int] = set()
        self.moves_alone: dict[int, float] = {}
        self.dither: random.Random | None = None
        """Source of the encoders' noise; without one they are exact, as far as counts go."""
        self.noise_factor: dict[int, float] = {}
        self.frozen_counts: set[int] = set()
        """Encoders that give their last count for ever, with a time stamp that runs on."""
        self.last_counts: dict[int, int] = {}
        self.encoder_drift: dict[int, float] = {}
        """How fast an encoder's zero moves [rad/s, m/s]."""
        self.encoder_error: dict[int, float] = {}
        self.spool_stuck: dict[int, float] = {}
        """Spools that stay where they are put [%]."""
        self.spool_gain: dict[int, float] = {}
        self.spools_measured = True
        """Whether the valve node has position sensors on its spools."""
        self.specs = [joint(settings.profile, j) for j in JOINTS]
        self.carrier = settings.profile.carrier
        self.articulation_rad = 0.0
        self.valves = [ValveMap(s.valve) for s in self.specs]
        self.spools = [0.0] * N_JOINTS
        self.plc_outputs = [0.0] * N_JOINTS
        """What a PLC drives the spools with; it passes the commands on, or does as told by ``plc_output``."""
        self.plc_output: dict[int, float] = {}
        self.openings = [0.0] * N_JOINTS
        self.lines = [deque([0.0] * max(1, round(s.valve.delay_s * 1e9 / T))) for s in self.specs]
        self.senders = {n: Sender(m.data_ids) for n, m in CODECS.items() if m.data_ids}
        self.dropped: set[str] = set()
        self.corrupt: set[str] = set()
        self.frozen: set[str] = set()
        self.changed: dict[str, dict[str, float]] = {}
        self.silent_nodes: set[int] = set()
        self.encoders = {e.node: EncoderNode(e) for e in encoders(settings.profile).values()}
        self.nodes = dict.fromkeys((1, 16, 32, 33, 34, 125), 5)
        self.pending: list[tuple[int, bytes]] = [heartbeat_frame(n, 0) for n in (*self.nodes, *self.encoders)]
        self.extra: list[tuple[int, bytes]] = []
        self.echo = 0
        self.sequence = 0
        self.setpoint_sequence = 0
        self.reports: list[StateReport] = []
        self.vehicle_reports: list[VehicleReport] = []
        self.commands_a: dict[str, Any] = {}
        self.commands_b: dict[str, Any] = {}
        self.machine_extra: list[tuple[int, bytes]] = []
        self.machine_commands: dict[str, dict[str, Any]] = {}
        self.machine_sent: list[tuple[int, bytes]] = []
        """All frames that the controller sent on mach0."""
        self.last_frames: dict[str, Frame] = {}
        if guard is not None:
            self.dropped.add("GuardStat")
            del self.nodes[0x7D]

    # -- environment

    def tick(self, datagrams: Iterable[bytes] = (), **measured: int) -> Outputs:
        """One period; commands come from an operator, everything else from the planner."""
        given = list(datagrams)
        commands = [d for d in given if is_operator_command(d)]
        return self.tick_with([d for d in given if d not in commands], commands, **measured)

    def tick_with(self, planner: Iterable[bytes] = (), operator: Iterable[bytes] = (), **measured: int) -> Outputs:
        """One period: the frames answered to the last SYNC reach the controller, which then steps."""
        self.now_ns += T
        stamp = self.now_ns - T + 1 * MS
        self.inputs.frames = [Frame(stamp, key, data) for key, data in self._answers()]
        self.inputs.machine_frames = [Frame(stamp, key, data) for key, data in self._machine_answers()]
        self.inputs.operator, self.inputs.datagrams = list(operator), list(planner)
        self.inputs.late_ns = measured.pop("late_ns", 0)
        for name, value in measured.items():  # bus_state, machine_bus_refused and so on go into the readings
            which, of_bus, counter = name.partition("bus_")
            if of_bus:
                setattr(self.inputs.machine_bus if which else self.inputs.bus, counter, value)
            else:
                setattr(self.inputs, name, value)
        outputs = step(self.controller, self.inputs, self.now_ns)
        self._apply_crane_frames(outputs)
        self._apply_carrier_frames(outputs)
        if self.guard is not None:
            frames = [frame for frame in self.inputs.frames if frame.key not in (0x1FD, 0x2FD, 0x77D)]
            frames += [Frame(self.now_ns, key, data) for key, data in outputs.frames]
            frames += self.inputs.machine_frames
            frames += [Frame(self.now_ns, key, data) for key, data in outputs.machine_frames]
            for command in self.inputs.operator:
                self.guard.hear(action_of(command, 0, self.now_ns)[0], self.now_ns)
            self.pending += split(self.guard.step(self.now_ns, frames))[0]
        if outputs.report is not None:
            report = decode(outputs.report)
            assert isinstance(report, StateReport)
            self.reports.append(report)
        if outputs.vehicle_report is not None:
            vehicle = decode(outputs.vehicle_report)
            assert isinstance(vehicle, VehicleReport)
            self.vehicle_reports.append(vehicle)
        self.count += 1
        return outputs

    def run(self, ticks: int, **measured: int) -> Mode:
        """The mode after some ticks."""
        for _ in range(ticks):
            self.tick(**measured)
        return self.mode

    def press(self, action: OperatorAction, **fields: int) -> Mode:
        """The mode after the tick in which a person presses a button."""
        self.tick([self.operator(action, **fields)])
        return self.mode

    def _answers(self) -> list[tuple[int, bytes]]:
        frames, self.pending = self.pending, []
        for place, encoder in encoders(self.settings.profile).items():
            if self.encoders[encoder.node].state == 0x05 and encoder.message not in self.dropped:
                counts = self._counts(place, encoder)
                values = {"Position": counts}
                codec = DATABASE.message(encoder.message)
                if "TimeStamp" in codec.index and encoder.message not in self.frozen:
                    values["TimeStamp"] = self.count & 0xFFFF
                frames.append(self._frame(encoder.message, values))
        for name, values in VALUES.items():
            if name == "PlcOut" and self.settings.profile.plc is None:
                continue
            if (self.count * 5) % PERIOD_MS.get(name, 5) == 0 and name not in self.dropped:
                more = self._feedback(name) if name in ("ValveFbA", "ValveFbB", "PlcOut") else {}
                frames.append(self._frame(name, {**values, **more}))
        if self.count % 20 == 0:
            states = {**self.nodes, **{n: e.state for n, e in self.encoders.items()}}
            frames += [heartbeat_frame(n, s) for n, s in states.items() if n not in self.silent_nodes]
        frames += self.extra
        self.extra = []
        return frames

    def _feedback(self, name: str) -> dict[str, float]:
        """The valve node follows while it is armed, and measures its spools; a PLC reports its outputs to them."""
        if name == "PlcOut":
            return {joint.name.capitalize(): 100.0 * self.plc_outputs[joint] for joint in JOINTS}
        measured = [100.0 * spool if self.spools_measured else None for spool in self.spools]
        if name == "ValveFbB":
            return {"EchoCounter": self.echo, "SpoolRot": measured[4]}
        state = 1 if self.commands_b.get("ArmKey") == 0xA else 0
        return {
            "State": state,
            **dict(zip(("SpoolSlew", "SpoolLift", "SpoolTilt", "SpoolExt"), measured, strict=False)),
        }

    def _counts(self, place: int, encoder: Any) -> int:
        if place in self.frozen_counts:
            return self.last_counts[place]
        position = self.q[place] if place < N_JOINTS else self.articulation_rad
        if place in self.encoder_drift:
            self.encoder_error[place] = self.encoder_error.get(place, 0.0) + self.encoder_drift[place] * T * 1e-9
            position += self.encoder_error[place]
        if self.dither is not None:
            position += self.dither.gauss(0.0, self.noise_factor.get(place, 1.0) * encoder.noise)
        elif place in self.stuck:  # a live encoder flickers on a joint that does not move
            position += (self.count % 2) * encoder.unit_per_count
        self.last_counts[place] = counts_from_position(encoder, position)
        return self.last_counts[place]

    def _machine_answers(self) -> list[tuple[int, bytes]]:
        frames, self.machine_extra = self.machine_extra, []
        for name, period_ms in MACHINE_PERIOD_MS.items() if self.carrier else ():
            if (self.count * 5) % period_ms == 0 and name not in self.dropped:
                key, data = self._frame(name, MACHINE_VALUES.get(name, {}))
                codec = CODECS[name]
                frames += packet(codec, data, SOURCES[codec.senders[0]]) if codec.by_pgn else [(key, data)]
        return frames

    def _frame(self, name: str, values: dict[str, float]) -> tuple[int, bytes]:
        codec = CODECS[name]
        values = {**values, **self.changed.get(name, {})}
        data = codec.encode(*(values.get(s.name, 0) for s in codec.signals))
        if codec.data_ids:
            if name in self.frozen and name in self.last_frames:
                return codec.key, self.last_frames[name].data
            data = self.senders[name].protect(data)
            self.last_frames[name] = Frame(0, codec.key, data)
        if name in self.corrupt:
            data = bytes([data[0] ^ 0x55]) + data[1:]
        return codec.key, data

    def _apply_crane_frames(self, outputs: Outputs) -> None:
        a, b = DATABASE.message("ValveCmdA"), DATABASE.message("ValveCmdB")
        for key, data in outputs.frames:
            if key == a.key:
                self.commands_a = a.named(a.decode(data))
                self.echo = self.commands_a["Counter"]
            elif key == b.key:
                self.commands_b = b.named(b.decode(data))
            elif key == 0:
                for node, encoder in self.encoders.items():
                    if data[1] in (0, node):
                        encoder.state = {0x01: 0x05, 0x80: 0x7F}[data[0]]
            else:
                for encoder in self.encoders.values():
                    answer = encoder.answer(key, data)
                    if answer is not None:
                        self.pending.append(answer)
        for j, spec in enumerate(self.specs):
            valve = spec.valve
            command = {**self.commands_a, **self.commands_b}[valve.signal] / 100.0
            command = self.plc_outputs[j] = self.plc_output.get(j, command)
            self.lines[j].append(command)
            lag = 1.0 - math.exp(-T * 1e-9 / valve.lag_s) if valve.lag_s else 1.0
            wanted = self.lines[j].popleft() * self.spool_gain.get(j, 1.0)
            self.spools[j] += lag * (self.spool_stuck.get(j, 100.0 * wanted) / 100.0 - self.spools[j])
            half, made = valve.hysteresis_pct / 200.0, self.valves[j]
            opening = max(self.spools[j] - half, min(self.spools[j] + half, self.openings[j]))
            self.openings[j] = opening
            made.set_position(self.q[j])
            deadband = (valve.deadband_plus_pct if opening > 0 else valve.deadband_minus_pct) / 100.0
            full = made.full_plus if opening > 0 else made.full_minus
            share = max(0.0, abs(opening) - deadband) / (1.0 - half - deadband)
            self.v[j] = 0.0 if j in self.stuck else (full if opening > 0 else -full) * share
            self.v[j] = self.moves_alone.get(j, 0.0) + (-self.v[j] if j in self.backward else self.v[j])
            self.q[j] += self.v[j] * T * 1e-9

    def _apply_carrier_frames(self, outputs: Outputs) -> None:
        self.machine_sent += outputs.machine_frames
        for key, data in outputs.machine_frames:
            codec = MACHINE.find(key)
            assert codec is not None
            self.machine_commands[codec.name] = codec.named(codec.decode(data))

    # -- messages of the operator and the planner

    def operator(self, action: OperatorAction, **fields: int) -> bytes:
        self.sequence += 1
        values = {
            "sequence": self.sequence,
            "profile_hash": self.settings.profile_hash,
            "stamp_ns": self.now_ns,
            **fields,
        }
        return encode(OperatorCommand(action=action, **values))

    def setpoint(self, knots, grapple=GrappleCommand.NEUTRAL, final=False, lease_ms=200, **fields) -> bytes:
        """``knots``: (after_ms, position, velocity)."""
        self.setpoint_sequence += 1
        values = {
            "sequence": self.setpoint_sequence,
            "profile_hash": self.settings.profile_hash,
            "stamp_ns": self.now_ns,
            "lease_ns": lease_ms * MS,
            **fields,
        }
        packed = tuple(Knot(round(ms * MS), tuple(p), tuple(v)) for ms, p, v in knots)
        return encode(CraneSetpoint(grapple=grapple, final=final, knots=packed, **values))

    def hold(self, **fields) -> bytes:
        """A setpoint that stays where the reference is."""
        reference = [r if r == r else 0.0 for r in self.controller.reference_position]
        return self.setpoint([(0, reference, [0.0] * 5), (400, reference, [0.0] * 5)], **fields)

    def moving(self, j: int, speed: float, lease_ms: int = 200, **fields) -> bytes:
        """A setpoint that continues from the reference with a constant velocity of one joint."""
        start = list(self.controller.reference_position)
        v = [0.0] * 5
        v[j] = speed
        end = list(start)
        end[j] += speed * 0.4
        return self.setpoint([(0, start, v), (400, end, v)], lease_ms=lease_ms, **fields)

    # -- states

    def boot(self) -> Bench:
        for _ in range(400):
            self.tick()
            if self.controller.supervisor.mode is Mode.STANDBY and self.controller.supervisor.reason == 0:
                return self
        raise AssertionError(f"no standby: {self.controller.supervisor.reason!r}")

    def armed(self) -> Bench:
        self.boot()
        assert self.press(OperatorAction.ARM) is Mode.ARMED, self.controller.gate.refusal
        return self

    def active(self, j: int = 0, speed: float = 0.08, ticks: int = 60) -> Bench:
        """ACTIVE and moving: the planner renews its setpoint every 50 ms."""
        self.armed()
        self.tick([self.hold()])
        assert self.drive(j, speed, ticks) is Mode.ACTIVE, self.controller.supervisor.reason
        return self

    def drive(self, j: int, speed: float, ticks: int) -> Mode:
        for k in range(ticks):
            self.tick([self.moving(j, speed)] if k % 10 == 0 else ())
        return self.mode

    def keep(self, ticks: int, **fields) -> Mode:
        """The mode after the crane was kept where it is, with a setpoint every 50 ms."""
        for k in range(ticks):
            self.tick([self.hold(**fields)] if k % 10 == 0 else ())
        return self.mode

    def until(self, reason: Reason, limit: int = 120, **measured: int) -> int:
        """Number of ticks until the reason is set; the planner goes on as long as it may."""
        for k in range(1, limit + 1):
            self.tick([self.moving(0, 0.08)] if k % 10 == 0 and self.mode is Mode.ACTIVE else (), **measured)
            if self.reason == reason:
                return k
        raise AssertionError(f"{reason.name} not seen; {self.mode.name} {self.reason!r}")

    @property
    def mode(self) -> Mode:
        return self.controller.supervisor.mode

    @property
    def reason(self) -> int:
        return self.controller.supervisor.reason

    @property
    def neutral(self) -> bool:
        """Whether the last commands are neutral on every function."""
        spools = [self.commands_a[s] for s in ("Slew", "Lift", "Tilt", "Ext")]
        spools += [self.commands_b[s] for s in ("Rot", "Grapple", "Aux")]
        return not any(spools) and self.commands_a["Mode"] == 0
