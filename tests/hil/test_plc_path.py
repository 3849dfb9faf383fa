"""The whole job through the PLC in lockstep: controller, guard, bridge, real bytes, emulated PLC, plant."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from autonomy.crane_job.activity import Activity
from can_dbc.plc.map import Fault, State
from controller.config import load
from controller.guard.__main__ import build as build_guard
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.plc.bridged_plant import BridgedPlant, Transport
from hil.plc.profile import write_plc_profile
from machine.status.modes import Mode
from machine.status.reasons import Reason

pytestmark = pytest.mark.computed

S = 1_000_000_000
MS = 1_000_000
RoleName = Literal["references", "valves"]


class Run:
    """One log, through a PLC."""

    def __init__(self, role: RoleName, transport: Transport, directory: Path, seed: int = 0) -> None:
        path = write_plc_profile("palms_471", role, directory)
        self.settings = settings = load(path)
        self.plant = BridgedPlant(settings.profile, seed, "sampled", transport=transport)
        self.activity = Activity(settings.profile, settings.profile_hash)
        self.system = Lockstep(
            settings,
            build_guard(path),
            self.plant,
            self.activity,
            Operator(settings.profile_hash, lambda *_: None),
            Observer(),
        )

    def until(self, mode: Mode, limit_s: float = 20.0) -> None:
        system = self.system
        while (system.report is None or system.report.mode != mode) and system.now_ns < START_NS + limit_s * S:
            system.advance()
        assert system.report is not None and Mode(system.report.mode) is mode

    def wait(self, ms: int) -> None:
        until_ns = self.system.now_ns + ms * MS
        while self.system.now_ns < until_ns:
            self.system.advance()

    def moving(self) -> bool:
        return any(abs(u) > 0.0 for u in self.plant.plc.outputs[:5])


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(("role", "transport"), [("references", "udp"), ("valves", "modbus")])
def test_a_cut_cable_stops_the_machine_within_100_ms_and_it_stays_stopped(
    role: RoleName, transport: Transport, tmp_path: Path
) -> None:
    run = Run(role, transport, tmp_path)
    run.until(Mode.ACTIVE)
    while not run.moving():
        run.system.advance()
    run.wait(1000)
    assert run.moving()
    run.plant.cut = True
    cut_ns = run.system.now_ns
    while run.moving():
        run.system.advance()
    assert run.system.now_ns - cut_ns <= 100 * MS, "every function neutral"
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


@pytest.mark.slow
def test_the_emergency_stop_behind_the_plc_stops_and_latches(tmp_path: Path) -> None:
    run = Run("references", "modbus", tmp_path)
    run.until(Mode.ACTIVE)
    while not run.moving():
        run.system.advance()
    run.plant.estop.press()
    pressed_ns = run.system.now_ns
    while run.moving():
        run.system.advance()
    assert run.system.now_ns - pressed_ns <= 30 * MS
    run.until(Mode.FAULT)
    assert run.system.report is not None and run.system.report.reason & 0xFF == Reason.ESTOP_PRESSED
    run.plant.estop.release()
    run.plant.estop.reset()
    run.wait(250)
    assert not run.moving()


@pytest.mark.slow
def test_a_fault_of_the_plc_stops_the_controller(tmp_path: Path) -> None:
    """The PLC holds and reports its fault; the controller stops with PLC_FAULT."""
    run = Run("references", "modbus", tmp_path)
    run.until(Mode.ACTIVE)
    while not run.moving():
        run.system.advance()
    run.plant.plc.arbiter.latch_fault(Fault.ILLEGAL_VALUE, 1)
    run.until(Mode.STOP)
    assert run.system.report is not None and run.system.report.reason & 0xFF == Reason.PLC_FAULT
    run.wait(50)
    assert not run.moving(), "its ramp takes 40 ms"
