"""The bridge as a process between a whole machine and a client of the wire, each in a process of its own."""

from __future__ import annotations

import json
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil.harness.processes import ProcessGroup, free_udp_ports
from machine.loading.profile_file import load_profile
from machine.profile import joint_limits
from sim.kinematic import START_SHARE

DOMAIN = 100 + secrets.randbelow(50)
"""Another one than a ROS 2 of this computer has, most likely; ports of greater domains may be the system's."""
START_S = 120.0
START = [low + START_SHARE * (high - low) for low, high in joint_limits(load_profile("palms_471"))]
"""Where the machine begins."""


def client(*arguments: str, seconds: float = 120.0) -> list[dict[str, Any]]:
    """The lines that a client prints; it may kill itself."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.live.ros2.wire_client", str(DOMAIN), *arguments],
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def go(*arguments: str) -> list[dict[str, Any]]:
    """What a client says that sends a goal."""
    return client("go", *arguments)


class Machine:
    """The machine and the bridge."""

    def __init__(self, processes: ProcessGroup) -> None:
        self.processes = processes
        (port,) = free_udp_ports(1)
        processes.start("machine", "tests.live.ros2.paced_machine", port)
        setpoints = processes.await_message("machine", "port", START_S)["port"]
        processes.start(
            "bridge", "ros2", "--report-port", port, "--controller", f"127.0.0.1:{setpoints}", "--domain", DOMAIN
        )
        self.modes: list[int] = []
        self.events: list[dict[str, Any]] = []
        self.until(lambda: any(e["event"] == "ready" for e in self.events) and self.modes[-1:] == [2], START_S)

    def until(self, condition: Any, seconds: float) -> None:
        """Read what both print until a condition holds."""
        end = time.monotonic() + seconds
        while not condition():
            for name, message in self.processes.messages():
                if name == "machine" and "mode" in message:
                    self.modes.append(message["mode"])
                elif name == "bridge":
                    self.events.append(message)
            gone = self.processes.dead()
            assert gone is None, gone and gone.complaint()
            assert time.monotonic() < end, (self.modes, self.events)
            time.sleep(0.02)

    def slew(self) -> float:
        """The slew as the wire tells it."""
        state = next(line for line in client("listen") if line["topic"] == "rt/joint_states")["message"]
        return float(state["position"][state["name"].index("slew")])


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    processes = ProcessGroup(tmp_path_factory.mktemp("ros2"))
    try:
        yield Machine(processes)
    finally:
        processes.stop_all(("bridge", "machine"))


@pytest.mark.timeout(400)
def test_the_machine_appears_as_a_node_with_its_joints_frames_and_mode(machine: Machine) -> None:
    heard = {line["topic"]: line for line in client("listen")}
    joints = heard["rt/joint_states"]
    state, stamp = joints["message"], joints["message"]["header"]["stamp"]
    assert state["name"] == ["slew", "lift", "tilt", "ext", "rot"]
    assert state["position"][:4] == pytest.approx(START[:4], abs=0.02)
    assert -0.5 < joints["now_s"] - stamp["sec"] - stamp["nanosec"] * 1e-9 < 2.0
    frames = {t["child_frame_id"]: t["header"]["frame_id"] for t in heard["rt/tf"]["message"]["transforms"]}
    assert frames["boom_link"] == "base_link" and frames["grapple_link"] == "hanger_link"
    still = [t["child_frame_id"] for t in heard["rt/tf_static"]["message"]["transforms"]]
    assert still == ["stick_optical_frame", "d435_optical_frame"]
    assert heard["rt/diagnostics"]["message"]["status"][0]["message"] == "ARMED"
    (node,) = heard["ros_discovery_info"]["message"]["node_entities_info_seq"]
    assert node["node_name"] == "timberhand" and len(node["reader_gid_seq"]) == 3 and len(node["writer_gid_seq"]) == 9


@pytest.mark.timeout(400)
def test_a_goal_moves_the_crane(machine: Machine) -> None:
    answer, end = go("-0.3", "6")
    assert answer == {"accepted": True} and (end["status"], end["code"]) == (4, 0), end
    assert end["feedbacks"] > 20 and end["last"]["joint_names"] == ["slew"] and end["statuses"][-1] == 4
    assert end["last"]["actual"]["positions"] == pytest.approx([-0.3], abs=0.02)
    assert machine.slew() == pytest.approx(-0.3, abs=0.02)


@pytest.mark.timeout(400)
def test_a_goal_out_of_limits_is_not_executed(machine: Machine) -> None:
    before = machine.slew()
    _, end = go("9", "60")
    assert (end["status"], end["code"], end["feedbacks"]) == (6, -1, 0) and "[ros2.goal-limits]" in end["text"]
    assert machine.slew() == pytest.approx(before, abs=0.005)


@pytest.mark.timeout(400)
def test_a_cancelled_goal_ends_in_a_hold(machine: Machine) -> None:
    before = machine.slew()
    _, cancelled, end = go(str(before - 0.6), "10", "cancel")
    assert cancelled == {"cancelled": 0, "goals": 1} and (end["status"], end["code"]) == (5, 0)
    assert before - 0.5 < machine.slew() < before - 0.01


@pytest.mark.timeout(400)
def test_a_client_that_is_killed_ends_in_a_hold(machine: Machine) -> None:
    before, count = machine.slew(), len(machine.modes)
    _, dead = go(str(before + 0.8), "16", "die")
    machine.until(lambda: machine.events[-1].get("reason", "").startswith("the client"), 10.0)
    ended = machine.events[-1]
    assert (ended["status"], ended["error"]) == ("ABORTED", 70) and ended["t_s"] - dead["dead_s"] < 6.0
    machine.until(lambda: machine.modes[-1] == 2, 10.0)
    assert not {4, 5} & set(machine.modes[count:])
    stands = machine.slew()
    assert before + 0.01 < stands < before + 0.6 and machine.slew() == pytest.approx(stands, abs=0.005)


@pytest.mark.timeout(400)
def test_a_bridge_that_is_ended_stops_the_crane_first(machine: Machine) -> None:
    """The last one: the bridge is gone afterwards."""
    before = machine.slew()
    running = subprocess.Popen(
        [sys.executable, "-m", "tests.live.ros2.wire_client", str(DOMAIN), "go", str(before - 0.6), "16"],
        stdout=subprocess.PIPE,
        text=True,
    )
    goals = sum(e["event"] == "goal" for e in machine.events)
    machine.until(lambda: sum(e["event"] == "goal" for e in machine.events) > goals, 60.0)
    time.sleep(2.0)
    bridge = machine.processes.children["bridge"].process
    bridge.send_signal(signal.SIGINT)
    assert bridge.wait(10.0) == 130
    out, _ = running.communicate(timeout=60.0)
    assert json.loads(out.splitlines()[-1])["text"]


@pytest.mark.timeout(300)
def test_a_cameras_pictures_arrive(tmp_path: Path) -> None:
    """From a server of frames like the plant's, over the camera's own process."""
    processes = ProcessGroup(tmp_path)
    try:
        processes.start("frames", "tests.live.ros2.frame_server")
        frames = processes.await_message("frames", "port", START_S)["port"]
        processes.start(
            "camera", "ros2.camera", "--camera", "d435", "--frames", f"127.0.0.1:{frames}", "--domain", DOMAIN
        )
        processes.await_message("camera", "event", START_S)
        heard = {line["topic"].removeprefix("rt/d435/"): line["message"] for line in client("look")}
    finally:
        processes.stop_all(("camera", "frames"))
    colour, depth, info = heard["image_rect_color"], heard["depth/image_rect"], heard["camera_info"]
    assert (colour["width"], colour["height"], colour["encoding"]) == (64, 48, "rgb8")
    assert colour["data"] == [64 * 48 * 3, 7 * 64 * 48 * 3]
    assert (depth["encoding"], depth["data"][0]) == ("16UC1", 64 * 48 * 2) and info["k"][0] == 40.0
    assert abs(colour["header"]["stamp"]["sec"] - time.time()) < 60.0
