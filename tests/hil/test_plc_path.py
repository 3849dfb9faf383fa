"""The whole job through the PLC in lockstep: controller, guard, bridge, real bytes, emulated PLC, plant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest

from autonomy.crane_job.activity import Activity
from can_dbc.frame import Frame, RawFrame
from can_dbc.messages.crane import ModeSwitch
from can_dbc.plc.map import Fault, Feedback, State
from controller.guard.guard import Verdict
from hil.harness.lockstep import START_NS
from hil.plc import BridgedPlant, Transport, write_plc_profile
from machine.loading.profile_file import load_profile, profile_hash
from machine.status.modes import Mode
from machine.status.reasons import Reason
from sim.plc.program import Inputs
from tests.hil.stand_ins import advance, in_lockstep

S = 1_000_000_000
MS = 1_000_000
RoleName = Literal["references", "valves"]


class Run:
    """One log, through a PLC."""

    def __init__(self, role: RoleName, transport: Transport, directory: Path, seed: int = 0) -> None:
        path = write_plc_profile("palms_471", role, directory)
        profile = load_profile(path)
        self.plant = BridgedPlant(profile, seed, "sampled", transport=transport)
        self.activity = Activity(profile, profile_hash(profile))
        self.system = in_lockstep(path, self.plant, self.activity)

    @property
    def reason(self) -> Reason:
        """Why the machine stands."""
        assert self.system.report is not None
        return Reason(self.system.report.reason & 0xFF)

    def until(self, mode: Mode, limit_s: float = 20.0) -> None:
        system = self.system
        while (system.report is None or system.report.mode != mode) and system.now_ns < START_NS + limit_s * S:
            system.advance()
        assert system.report is not None and Mode(system.report.mode) is mode

    def wait(self, ms: int) -> None:
        advance(self.system, ms / 1000)

    def moving(self) -> bool:
        return any(abs(u) > 0.0 for u in self.plant.plc.outputs[:5])

    def start(self) -> None:
        """Until the crane has moved for half a second."""
        self.until(Mode.ACTIVE)
        while not self.moving():
            self.system.advance()
        self.wait(500)
        assert self.moving()

    def neutral_after_ms(self) -> float:
        """How long the PLC's outputs take to be neutral from now on."""
        began_ns = self.system.now_ns
        while self.moving() and self.system.now_ns < began_ns + S:
            self.system.advance()
        return (self.system.now_ns - began_ns) / MS


@pytest.mark.long
@pytest.mark.parametrize(("role", "transport"), [("references", "modbus"), ("valves", "udp")])
def test_a_log_lands_in_the_bunk(role: RoleName, transport: Transport, tmp_path: Path) -> None:
    run = Run(role, transport, tmp_path)
    while not run.activity.done and not run.activity.failure and run.system.now_ns < START_NS + 120 * S:
        run.system.advance()
    limit_ns = run.system.now_ns + 3 * S
    while not run.plant.evaluate().success and run.system.now_ns < limit_ns:
        run.system.advance()
    assert run.activity.done and run.plant.evaluate().success, run.activity.failure
    assert run.system.operator.stops == 0
    shake, gate = run.plant.bridge.handshake, run.plant.plc.arbiter
    assert (shake.refused, shake.dropped, run.plant.bridge.gate.refused) == (0, 0, 0)
    assert (gate.refused, gate.dropped, gate.fault) == (0, 0, Fault.NONE)
    assert gate.accepted >= shake.sent - 2, "every command was a new one and was taken"


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 5])
def test_a_machine_that_is_slowed_again_and_again_works_on(seed: int, tmp_path: Path) -> None:
    """The PLC's loop answers a change of speed a quarter of a second late: that is no joint gone wrong."""
    run, due_ns = Run("references", "modbus", tmp_path, seed), START_NS + 5 * S
    while not run.activity.done and not run.activity.failure and run.system.now_ns < START_NS + 120 * S:
        run.system.advance()
        if run.system.now_ns >= due_ns:
            run.system._controller.supervisor.react_to(Reason.BUS_PASSIVE, 0, run.system.now_ns)
            due_ns += 1800 * MS
    assert run.activity.done, run.activity.failure
    assert run.system.operator.stops == 0
    assert run.plant.bridge.gate.refused == 0


@pytest.mark.long
@pytest.mark.parametrize(("role", "transport"), [("references", "udp"), ("valves", "modbus")])
def test_a_cut_cable_stops_the_machine_within_100_ms_and_it_stays_stopped(
    role: RoleName, transport: Transport, tmp_path: Path
) -> None:
    run = Run(role, transport, tmp_path)
    run.start()
    run.plant.cut = True
    cut_ns = run.system.now_ns
    assert run.neutral_after_ms() <= 100, "every function neutral"
    run.until(Mode.FAULT)
    while run.plant.plc.state is not State.SAFE:
        run.system.advance()
    assert run.system.now_ns - cut_ns <= 330 * MS
    run.plant.cut = False
    for _ in range(100):
        run.wait(5)
        assert not run.moving()
    assert run.system.report is not None and run.system.report.mode == Mode.FAULT, "until a human resets it"
    run.until(Mode.ACTIVE, 60.0)
    assert run.system.operator.stops == 1
    while not run.moving():
        run.system.advance()


@pytest.mark.long
def test_the_emergency_stop_behind_the_plc_stops_and_latches(tmp_path: Path) -> None:
    run = Run("references", "modbus", tmp_path)
    run.start()
    run.plant.estop.turn(ModeSwitch.AUTO)
    run.wait(60)
    assert run.moving() and run.system.report is not None and run.system.report.mode_switch == ModeSwitch.AUTO
    run.plant.estop.press()
    assert run.neutral_after_ms() <= 30
    run.until(Mode.FAULT)
    assert run.reason is Reason.ESTOP_PRESSED
    run.plant.estop.release()
    run.plant.estop.reset()
    run.wait(250)
    assert not run.moving()


@pytest.mark.long
def test_a_fault_of_the_plc_stops_the_controller(tmp_path: Path) -> None:
    """The PLC holds and reports its fault; the controller stops with PLC_FAULT."""
    run = Run("references", "modbus", tmp_path)
    run.start()
    run.plant.plc.arbiter.latch_fault(Fault.ILLEGAL_VALUE, 1)
    run.until(Mode.STOP)
    assert run.reason is Reason.PLC_FAULT
    run.wait(50)
    assert not run.moving(), "its ramp takes 40 ms"


class Damage:
    """What a PLC or a bridge does to the emergency stop's frames, from ``begin`` on."""

    def __init__(self, plant: BridgedPlant, kind: str) -> None:
        self._plant, self._kind = plant, kind
        self._key = plant._estop_key
        self._last: bytes = b""

    def begin(self) -> None:
        if self._kind == "altered":
            self._wrap(lambda data: data[:3] + bytes((data[3] ^ 0x10,)) + data[4:])
            return
        self._plant._estop_key = -1  # the safety module is cut off; the PLC keeps the last frame
        if self._kind == "repeated":
            self._last = self._plant._estop_frame
            self._wrap(lambda data: data)

    def _wrap(self, change: Callable[[bytes], bytes]) -> None:
        bridge = self._plant.bridge
        step = bridge.step

        def damaged(now_ns: int, frames: list[Frame]) -> list[RawFrame]:
            out = [(key, change(data) if key == self._key else data) for key, data in step(now_ns, frames)]
            if self._last and now_ns % (10 * MS) == 0:
                out.append((self._key, self._last))
            return out

        bridge.step = damaged  # type: ignore[method-assign]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["silent", "repeated", "altered"])
def test_controller_and_guard_both_catch_a_state_of_the_emergency_stop_that_is_not_the_safety_modules_own(
    kind: str, tmp_path: Path
) -> None:
    run = Run("valves", "udp", tmp_path)
    damage = Damage(run.plant, kind)
    run.start()
    damage.begin()
    assert run.neutral_after_ms() <= 100
    run.wait(50)
    assert run.reason is Reason.ESTOP_LOST
    assert run.system._guard.verdict in (Verdict.ESTOP_LOST, Verdict.CORRUPT)
    run.wait(1000)
    assert not run.moving()


@pytest.mark.long
@pytest.mark.parametrize(("role", "transport"), [("references", "udp"), ("valves", "modbus")])
def test_encoders_that_the_plc_only_repeats_are_lost(role: RoleName, transport: Transport, tmp_path: Path) -> None:
    """Its cycle and its heartbeat run on; the samples do not."""
    run = Run(role, transport, tmp_path)
    run.start()
    program = run.plant.plc
    make, kept = program._make_feedback, program.feedback

    def frozen(inputs: Inputs, now_ns: int) -> Feedback:
        return replace(make(inputs, now_ns), position=kept.position, sampled_us=kept.sampled_us)

    program._make_feedback = frozen  # type: ignore[method-assign]
    assert run.neutral_after_ms() <= 100
    run.wait(50)
    assert run.reason in (Reason.ENCODER_LOST, Reason.VALVE_NODE_FAULT)
