"""The emulated PLC's program on virtual time: states, reactions to silence and emergency stop, joint law."""

from __future__ import annotations

import math

import msgspec
import pytest

from can_dbc.plc.map import Command, Estop, Fault, Grapple, Mode, Role, State, WordOrder, command_registers
from machine.joints import JOINTS, Joint
from machine.loading.profile_file import load_profile
from machine.profile import joint
from sim.errors import PlantError
from sim.plc.command_arbiter import MS
from sim.plc.plant import PlcPlant
from sim.plc.program import CYCLE_NS, MOTION_ALLOWED, RESOLUTION_M, RESOLUTION_RAD, Inputs, Program, stop_band
from tests.codes import coded

PROFILE = load_profile("palms_471")
HOME = (0.0, 0.75, -1.6, 0.3, 0.0)
SPOOLS = Command(Mode.VALVES, True, (0.5, -0.25, 0, 0, 0, 0, 0), grapple=Grapple.OPEN, grapple_pct=100)


class Rig:
    """A program with adjustable inputs; ``run`` scans in physics steps and can send commands meanwhile."""

    def __init__(self, role: Role) -> None:
        self.inputs = Inputs(HOME, (10.0,) * 8, 1.0, 0.0, MOTION_ALLOWED)
        self.program = Program(PROFILE, role, lambda _: self.inputs)
        self.now_ns = 0
        self.sequence = 0

    def run(self, ms: float, command: Command | None = None) -> None:
        """``command`` is sent anew every 10 ms."""
        for _ in range(round(ms / 2.5)):
            if command is not None and self.now_ns % (10 * MS) == 0:
                self.sequence += 1
                block = command_registers(command, self.sequence, self.sequence & 0xFFFF, WordOrder.HIGH_FIRST)
                self.program.arbiter.write(1, 100, block, self.now_ns)
            self.program.scan(self.now_ns)
            self.now_ns += 2_500_000

    @property
    def state(self) -> State:
        return self.program.state


def test_it_holds_until_an_armed_command_and_executes_it() -> None:
    rig = Rig(Role.VALVES)
    assert rig.program.state is State.INIT
    rig.run(50)
    assert rig.state is State.HOLD and not any(rig.program.outputs)
    rig.run(50, Command(Mode.NEUTRAL, False))
    assert rig.state is State.HOLD
    rig.run(50, SPOOLS)
    assert rig.state is State.EXECUTE
    assert rig.program.outputs == [0.5, -0.25, 0.0, 0.0, 0.0, 1.0]
    assert rig.program.feedback.accepted == rig.sequence


def test_50_ms_without_commands_ramps_to_neutral_and_a_new_command_resumes() -> None:
    rig = Rig(Role.VALVES)
    rig.run(100, SPOOLS)
    rig.run(50)
    assert rig.state is State.EXECUTE, "50 ms are allowed"
    rig.run(20)
    assert rig.state is State.HOLD and 0.0 < rig.program.outputs[0] <= 0.5
    assert rig.program.outputs[-1] == 0.0, "the grapple's valve shuts at once"
    rig.run(40)
    assert not any(rig.program.outputs), "neutral within 100 ms of the last command and one cycle"
    rig.run(20, SPOOLS)
    assert rig.state is State.EXECUTE


def test_300_ms_without_commands_is_safe_and_latched() -> None:
    rig = Rig(Role.VALVES)
    rig.run(100, SPOOLS)
    rig.run(300)
    assert rig.state is State.HOLD
    rig.run(20)
    assert (rig.state, rig.program.feedback.fault) == (State.SAFE, Fault.WATCHDOG)
    rig.run(100, SPOOLS)
    assert rig.state is State.SAFE and not any(rig.program.outputs), "it never starts again by itself"
    rig.run(50, Command(Mode.VALVES, True, SPOOLS.reference, reset=True))
    assert rig.state is State.SAFE, "a reset with the arm key is none"
    rig.run(20, Command())
    rig.run(20, Command(reset=True))
    assert (rig.state, rig.program.feedback.fault) == (State.HOLD, Fault.NONE)
    rig.run(20, SPOOLS)
    assert rig.state is State.EXECUTE


@pytest.mark.parametrize("open_contact", [Estop.CHANNEL_A, Estop.CHANNEL_B, Estop.PILOT_ON])
def test_an_open_emergency_stop_is_neutral_at_once(open_contact: Estop) -> None:
    rig = Rig(Role.VALVES)
    rig.run(100, SPOOLS)
    rig.inputs.estop &= ~open_contact
    rig.run(CYCLE_NS / MS, SPOOLS)
    assert rig.state is State.SAFE and not any(rig.program.outputs)
    assert rig.program.feedback.fault == Fault.EMERGENCY_STOP
    rig.run(20, Command(reset=True))
    assert rig.state is State.SAFE, "no reset while it is open"
    rig.inputs.estop = int(MOTION_ALLOWED)
    rig.run(20, SPOOLS)
    assert rig.state is State.SAFE
    rig.run(20, Command())
    rig.run(20, Command(reset=True))
    assert rig.state is State.HOLD


def test_an_illegal_value_stops_it_until_a_reset() -> None:
    rig = Rig(Role.VALVES)
    rig.run(100, SPOOLS)
    rig.program.arbiter.latch_fault(Fault.ILLEGAL_VALUE, 3)
    rig.run(20, SPOOLS)
    assert rig.state is State.HOLD
    rig.run(50, SPOOLS)
    assert not any(rig.program.outputs) and rig.program.feedback.fault_axis == 3


def test_a_grapple_holds_with_neutral_joints() -> None:
    rig = Rig(Role.VALVES)
    rig.run(100, Command(Mode.NEUTRAL, True, grapple=Grapple.HOLD))
    assert rig.program.outputs == [0.0, 0.0, 0.0, 0.0, 0.0, -0.2]


def test_feedback_is_in_tenths_of_degrees_and_millimetres() -> None:
    rig = Rig(Role.REFERENCES)
    rig.inputs.positions = (0.12345, 0.7, -1.61803, 0.300049, math.pi / 2)
    rig.run(50)
    for j, got in zip(JOINTS, rig.program.feedback.position, strict=False):
        resolution = RESOLUTION_M if j is Joint.EXT else RESOLUTION_RAD
        assert got / resolution == pytest.approx(round(got / resolution), abs=1e-9)
        assert abs(got - rig.inputs.positions[j]) <= 0.5 * resolution + 1e-12


def test_the_law_moves_every_joint_to_its_reference_and_rests() -> None:
    """On an ideal valve with 80 ms of dead time; the stop band keeps the quantised feedback from hunting."""
    rig = Rig(Role.REFERENCES)
    specs = [joint(PROFILE, j) for j in JOINTS]
    target = (0.2, 0.85, -1.4, 0.5, 0.4)
    command = Command(Mode.REFERENCES, True, (*target, 0.0, 0.0))
    q, line = list(HOME), [[0.0] * 5] * 32
    for _ in range(3200):
        rig.run(2.5, command)
        line = [*line[1:], rig.program.outputs[:5]]
        for i, (spec, u) in enumerate(zip(specs, line[0], strict=True)):
            v = spec.valve
            band, full = (
                (v.deadband_plus_pct, v.full_speed_plus) if u > 0 else (v.deadband_minus_pct, v.full_speed_minus)
            )
            opened = max(0.0, abs(u) - band / 100.0) / (1.0 - band / 100.0)
            q[i] += math.copysign(opened * full, u) * 0.0025
        rig.inputs.positions = tuple(q)
    for spec, at, to in zip(specs, q, target, strict=True):
        assert abs(at - to) < stop_band(spec) + RESOLUTION_RAD
    assert not any(rig.program.outputs[:5]), "at rest"


def test_a_speed_share_slows_the_law() -> None:
    outputs = []
    for share in (100, 50):
        rig = Rig(Role.REFERENCES)
        rig.run(2000, Command(Mode.REFERENCES, True, (1.0, *HOME[1:], 0, 0), max_speed_pct=share))
        outputs.append(rig.program.outputs[0])
    assert outputs[0] > outputs[1] > 0.0


def test_a_machine_that_drives_has_no_emulated_plc() -> None:
    profile = msgspec.structs.replace(load_profile("aoro_fc8"))
    with pytest.raises(PlantError, check=coded("plc.mobile-machine")):
        PlcPlant(profile, role=Role.VALVES)
