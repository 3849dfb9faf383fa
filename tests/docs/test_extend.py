"""The examples of `docs/how-to/extend.md`, found by their entry points and at work on virtual time."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from autonomy.crane_job.activity import Activity
from autonomy.crane_job.phases import Phase
from autonomy.grasp.planner import GraspRequest, NoGrasp
from autonomy.grasp.planners import PlannerChoice
from autonomy.grasp.selection import PlannerSelection
from autonomy.motion.arm_kinematics import Arm
from autonomy.perception.camera.frame import RgbdFrame, optical_pose
from autonomy.perception.log_list import LogObservation
from can_dbc.dbc.codec import load as load_database
from can_dbc.frame import Frame
from can_dbc.plc.machine import MACHINES
from can_dbc.plc.map import Feedback
from controller.config import Settings, load
from controller.guard.__main__ import build as build_guard
from controller.laws.feedback import Foreign, law_of
from controller.plc.bridge import EXCHANGE_NS, Bridge
from controller.step import Controller
from experiments.common.plugins import LOG_DETECTORS
from experiments.loop_design.page import with_law
from experiments.loop_design.study import CaseSet, study
from hil.harness.lockstep import START_NS, Lockstep, Observer
from hil.harness.operator import Operator
from hil.plc import write_plc_profile
from machine.loading.profile_file import ProfileError, load_profile, profile_file, profile_hash
from machine.profile import Profile
from machine.status.modes import Mode
from runtime.errors import ConfigError, InputRefused
from runtime.plugins import load_plugin
from sim.camera.rig import CameraRig
from sim.plant import Plant
from sim.wood.log_shape import LogSpec
from sim.world import World, open_world
from tests.codes import coded
from tests.docs.pages import ROOT

EXAMPLE = ROOT / "docs" / "examples" / "extend"
PALMS = load_profile("palms_471")
PALMS_FILE = profile_file("palms_471")
S = 1_000_000_000


def settings_of(profile: Profile) -> Settings:
    return Settings(profile, profile_hash(profile), profile.rate_hz)


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example's package as an installer leaves it."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    there = tmp_path / "site" / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    there.mkdir(parents=True)
    (there / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups]
    (there / "entry_points.txt").write_text("\n".join(lines))
    for folder in (there.parent, EXAMPLE):
        monkeypatch.syspath_prepend(str(folder))


# -- planner -----------------------------------------------------------------------------------------------------------


def log(x: float, y: float, yaw: float = 0.0) -> LogObservation:
    return LogObservation(0, (x, y, -0.9), (math.cos(yaw), math.sin(yaw), 0.0), 3.0, 0.2)


def test_the_planner_grasps_across_the_principal_axis_of_what_fits() -> None:
    planner, arm = PlannerChoice("pca").make(), Arm(PALMS)
    found = planner(GraspRequest(arm, [log(4.0, 0.0), log(4.0, 0.25), log(4.0, 2.5), log(4.0, -0.5, 1.2)], 0.0))
    assert sorted(found.logs) == [0, 1] and abs(found.y_m - 0.125) < 0.01 and abs(found.x_m - 4.0) < 0.01
    assert abs(np.cos(found.yaw_rad)) < 0.01, "the jaws open across logs that lie along x"
    with pytest.raises(NoGrasp, check=coded("pca.nothing")):
        planner(GraspRequest(arm, [log(40.0, 0.0)], 0.0))
    with pytest.raises(NoGrasp, check=coded("pca.nothing")):
        planner(GraspRequest(arm, [log(4.0, 0.0)], 0.0, stay=(0,)))


# -- detector ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def world() -> Iterator[World]:
    x, y = PALMS.workspace.pick_center_m
    scene = (LogSpec(x, y, 0.3, 2.6, 0.25, 605.0), LogSpec(x - 0.2, y + 0.8, 0.4, 2.5, 0.18, 605.0))
    made = open_world(PALMS, seed=1, scene=scene)
    yield made
    made.close()


def test_the_detector_sees_the_logs_of_a_picture_where_they_lie(world: World) -> None:
    frame = CameraRig(world, PALMS, world.truth, 1, size_px=None).frame("stick", S)
    seen = load_plugin(LOG_DETECTORS, "bark")(RgbdFrame("stick", S, frame.rgb, frame.depth_m, frame.intrinsics))
    pose = optical_pose(PALMS, PALMS.cameras["stick"], [world.q[name] for name in ("slew", "lift", "tilt", "ext")])
    states = world.log_bodies.states()
    assert len(seen) == len(states)
    for log_seen, truth in zip(sorted(seen, key=lambda s: s.diameter_m, reverse=True), states, strict=True):
        assert math.dist(pose.to_base(np.array(log_seen.center_m)), truth.position_m) < 0.3
        assert abs(float(pose.rotation @ np.array(log_seen.axis) @ np.array(truth.axis))) > 0.98
        assert abs(log_seen.diameter_m - truth.diameter_m) < 0.06 and abs(log_seen.length_m - truth.length_m) < 0.6


def test_the_detector_sees_nothing_where_no_depth_is_known(world: World) -> None:
    frame = CameraRig(world, PALMS, world.truth, 1, size_px=None).frame("stick", S)
    blind = np.full_like(frame.depth_m, np.nan)
    assert not load_plugin(LOG_DETECTORS, "bark")(RgbdFrame("stick", S, frame.rgb, blind, frame.intrinsics))


# -- joint law ---------------------------------------------------------------------------------------------------------


def test_the_joint_law_forgets() -> None:
    spec = with_law(PALMS, "leaky_pi").joints["slew"].law
    law = law_of(spec)
    assert isinstance(law, Foreign)
    assert law.step(0.01, 0.0, 0.005, True) == pytest.approx(0.01 * spec.kp_1_s)
    for _ in range(400):
        law.step(0.01, 0.0, 0.005, False)
    wound = law.step(0.0, 0.0, 0.005, True)
    for _ in range(400):
        law.step(0.0, 0.0, 0.005, False)
    assert 0.0 < law.step(0.0, 0.0, 0.005, True) == pytest.approx(wound * math.exp(-1.0), rel=0.01)
    law.reset()
    assert law.step(0.0, 0.0, 0.005, True) == 0.0


def test_a_profile_may_name_only_a_law_that_is_installed(tmp_path: Path) -> None:
    text = PALMS_FILE.read_text()
    for name in ("leaky_pi", "nobody"):
        (tmp_path / f"{name}.toml").write_text(text.replace('kind = "sliding_mode"', f'kind = "{name}"'))
    assert load_profile(tmp_path / "leaky_pi.toml").joints["slew"].law.kind == "leaky_pi"
    with pytest.raises(ProfileError, check=coded("profile.wrong-values")) as refused:
        load_profile(tmp_path / "nobody.toml")
    assert {problem.code for problem in refused.value.problems} == {"profile.law-unknown"}


def test_a_law_that_cannot_be_loaded_stops_the_start_and_one_without_a_number_the_controller() -> None:
    with pytest.raises(ConfigError, check=coded("plugin.unknown")):
        Controller(settings_of(with_law(PALMS, "nobody")))
    law = law_of(with_law(PALMS, "leaky_pi").joints["slew"].law)
    with pytest.raises(ArithmeticError):
        law.step(math.nan, 0.0, 0.005, True)


def test_the_margins_of_a_law_that_nobody_knows_are_not_invented() -> None:
    with pytest.raises(InputRefused, check=coded("loop-design.foreign-law")):
        study(with_law(PALMS, "leaky_pi"), CaseSet({"slew": []}, {}, (), ()))


@pytest.mark.long
def test_planner_and_joint_law_lay_a_log_into_the_bunk() -> None:
    profile = with_law(PALMS, "leaky_pi")
    settings = settings_of(profile)
    plant = Plant(profile, 7, "sampled")
    selector = PlannerSelection(PlannerChoice("pca").make())
    activity = Activity(profile, settings.profile_hash, grasp_selector=selector)
    operator = Operator(settings.profile_hash, lambda *_: None)
    guard = build_guard(PALMS_FILE)
    system = Lockstep(settings, guard, plant, activity, operator, Observer())
    while not activity.done and not activity.failure and system.now_ns < START_NS + 120 * S:
        system.advance()
    for _ in range(2400):
        system.advance()
    assert activity.done and plant.evaluate().success, activity.failure
    assert operator.stops == 0


# -- machine -----------------------------------------------------------------------------------------------------------


class Desk:
    """The bridge and the machine, with the interface of a plant."""

    def __init__(self, profile: Profile) -> None:
        self.now_ns = START_NS
        self.machine = load_plugin(MACHINES, "desk", lambda: self.now_ns)
        self.machine.connect()
        self._bus, self._bridge, self._due_ns = profile.crane_bus, Bridge(profile, load_database("crane")), 0
        self._bridge.handshake.connected()

    @property
    def feedback(self) -> Feedback:
        return self._bridge.handshake.feedback or Feedback()

    def driven(self) -> bool:
        """Whether a valve is open."""
        return any(self.feedback.output)

    def step(self, now_ns: int, received: list[tuple[str, Frame]]) -> list[tuple[str, int, bytes]]:
        self.now_ns, bridge = now_ns, self._bridge
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + EXCHANGE_NS
            try:
                bridge.handshake.exchange(self.machine, bridge.command(now_ns), now_ns)
            except OSError as error:
                bridge.handshake.exchange_failed(str(error))
        return [(self._bus, key, data) for key, data in bridge.step(now_ns, [frame for _, frame in received])]


class OneLog:
    """A detector that always sees the same log."""

    def detect(self, q: Sequence[float], now_ns: int) -> tuple[LogObservation, ...]:
        return (log(*PALMS.workspace.pick_center_m),)


class DeskRun:
    """A planner, a controller and a guard at the desk."""

    def __init__(self, directory: Path) -> None:
        path = write_plc_profile("palms_471", "valves", directory)
        settings = load(path)
        self.desk, self.activity = Desk(settings.profile), Activity(settings.profile, settings.profile_hash)
        operator, plant = Operator(settings.profile_hash, lambda *_: None), cast(Plant, self.desk)
        self.system = Lockstep(settings, build_guard(path), plant, self.activity, operator, Observer(), OneLog())

    def until(self, happened: Callable[[], bool], limit_s: float) -> None:
        end_ns = self.system.now_ns + int(limit_s * S)
        while not happened() and self.system.now_ns < end_ns:
            self.system.advance()
        assert happened()

    def mode(self) -> int:
        return self.system.report.mode if self.system.report else Mode.BOOT


def test_the_machine_is_set_up_armed_and_moved_and_a_disconnected_one_stops_the_controller(tmp_path: Path) -> None:
    run = DeskRun(tmp_path)
    run.until(run.desk.driven, 6.0)
    assert run.mode() == Mode.ACTIVE
    before = run.desk.feedback.position
    run.until(lambda: math.dist(run.desk.feedback.position, before) > 0.01, 2.0)
    run.desk.machine.disconnect()
    run.until(lambda: run.mode() in (Mode.STOP, Mode.FAULT), 0.2)
    with pytest.raises(OSError, match="connected"):
        run.desk.machine.observe()


def test_the_machine_is_neutral_when_its_commands_stop(tmp_path: Path) -> None:
    run = DeskRun(tmp_path)
    run.until(run.desk.driven, 6.0)
    run.desk.now_ns += 60_000_000  # nobody has commanded it in this time
    assert not any(run.desk.machine.observe().output)


@pytest.mark.long
def test_the_machine_goes_to_the_log_and_closes_its_grapple(tmp_path: Path) -> None:
    run = DeskRun(tmp_path)
    run.until(lambda: run.activity.phase is Phase.CLOSE, 30.0)
    assert run.mode() == Mode.ACTIVE and run.system.operator.stops == 0
