"""The machine with a carrier in lockstep: both buses, from power-on to a small motion of the crane."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from can_dbc.messages import tick_record
from can_dbc.messages.crane import CraneSetpoint, GrappleCommand, Knot, OperatorAction, StateReport
from can_dbc.messages.datagrams import encode
from hil.harness.lockstep import Lockstep, Observer
from hil.harness.operator import Operator
from hil.replay.recording import files_of
from machine.joints import N_JOINTS, Joint
from machine.status.modes import Mode
from recorder.manifest import describe
from recorder.recorder import Recorder
from sim.plant import Plant
from tests.hil.stand_ins import SETTINGS, in_lockstep

pytestmark = pytest.mark.long
MS = 1_000_000
PROFILE = SETTINGS.profile
TURN_RAD, TURN_S, REST_S = 0.12, 3.0, 2.0
LIMIT_S = 12.0


class SlewALittle:
    """A planner that turns the crane by a little, once, as soon as the machine is armed, and lets it come to rest."""

    def __init__(self) -> None:
        self.start: list[float] = []
        self.begin_ns = self.sequence = 0
        self.ended = self.done = False

    def step(self, now_ns: int, report: StateReport | None, logs: tuple) -> bytes | None:
        if report is None or report.mode not in (Mode.ARMED, Mode.ACTIVE):
            return None
        if self.ended:
            self.done = report.mode == Mode.ARMED
            return None
        if not self.start:
            self.start, self.begin_ns = [q if q == q else 0.0 for q in report.reference], now_ns
        elapsed_s = (now_ns - self.begin_ns) * 1e-9
        self.ended = elapsed_s > TURN_S + REST_S
        self.sequence += 1
        knots = tuple(Knot(round(ahead * 1e9), *self._at(elapsed_s + ahead)) for ahead in (0.0, 0.1, 0.2, 0.3))
        stamp = {"profile_hash": SETTINGS.profile_hash, "stamp_ns": now_ns, "lease_ns": 200 * MS}
        return encode(
            CraneSetpoint(self.sequence, **stamp, grapple=GrappleCommand.NEUTRAL, final=self.ended, knots=knots)
        )

    def _at(self, t_s: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        u = min(max(t_s / TURN_S, 0.0), 1.0)
        position, velocity = list(self.start), [0.0] * N_JOINTS
        position[Joint.SLEW] += TURN_RAD * u * u * (3.0 - 2.0 * u)
        velocity[Joint.SLEW] = TURN_RAD * 6.0 * u * (1.0 - u) / TURN_S
        return tuple(position), tuple(velocity)


@pytest.fixture(scope="module")
def life(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, list[StateReport], Lockstep]]:
    directory = tmp_path_factory.mktemp("carrier") / "run"
    plant = Plant(PROFILE, seed=11, logs=0)
    buses = (PROFILE.crane_bus, PROFILE.machine_bus or "")
    recorder = Recorder(directory, PROFILE, describe(PROFILE, buses, 11))
    reports: list[StateReport] = []
    pressed: list[OperatorAction] = []
    operator = Operator(SETTINGS.profile_hash, lambda action, _: pressed.append(action))
    planner = SlewALittle()
    system = in_lockstep(PROFILE.name, plant, planner, operator, Observer(recorder, [reports.append]))
    while not planner.done and system.now_ns < (1.0 + LIMIT_S) * 1e9:
        system.advance()
    recorder.close()
    assert pressed == [OperatorAction.ARM]
    yield directory, reports, system
    plant.close()


def test_it_reaches_standby_is_armed_and_slews(life) -> None:
    _, reports, system = life
    modes = [Mode(r.mode) for r in reports]
    order = [m for k, m in enumerate(modes) if k == 0 or m is not modes[k - 1]]
    assert order == [Mode.BOOT, Mode.STANDBY, Mode.ARMED, Mode.ACTIVE, Mode.ARMED]
    last = reports[-1]
    before = next(r for r in reports if r.mode == Mode.ARMED)
    assert last.position[Joint.SLEW] - before.position[Joint.SLEW] == pytest.approx(TURN_RAD, abs=0.01)
    assert last.reason == last.stale_mask == last.refused == 0
    assert system.operator.stops == 0


def ticks(directory: Path) -> list[tick_record.TickRecord]:
    (path,) = files_of(directory)
    with path.open("rb") as file:
        return [tick_record.decode(m.data) for *_, m in make_reader(file).iter_messages("/controller/tick")]


def test_the_carrier_stands_with_its_brake_on(life) -> None:
    directory, _, system = life
    vehicle = system.plant.vehicle()
    assert abs(vehicle.speed_m_s) < 0.01 and abs(vehicle.articulation_rad) < 0.01
    topics = {"/mach0/VehCmd": [], "/mach0/VehStat": [], "/mach0/ArmHeightA": []}
    with files_of(directory)[0].open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(list(topics)):
            topics[channel.topic].append(json.loads(message.data))
    commands, states, arms = topics.values()
    assert all((c["Brake"], c["Speed"], c["ArmKey"]) == (100, 0, 0) for c in commands)
    # The vehicle node follows our counter, so our frames arrive there and are good.
    assert {s["EchoCounter"] for s in states} == set(range(16))
    # In the first second the guard has not switched the pilot supply on.
    assert {s["Fault"] for s in states[:50]} <= {0, 2} and {s["Fault"] for s in states[50:]} == {0}
    assert {a["State"] for a in arms} == {0}
    assert 45 < len(commands) / (len(ticks(directory)) / SETTINGS.rate_hz) < 55


def test_an_encoder_sample_is_at_most_one_sync_lead_old_when_used(life) -> None:
    directory, _, _ = life
    slew = 0x182
    ages = [t.now_ns - f.stamp_ns for t in ticks(directory)[-200:] for f in t.frames_in if f.key == slew]
    assert len(ages) == 200 and max(ages) < SETTINGS.period_ns // 2
