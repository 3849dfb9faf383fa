"""The whole machine as separate processes on a real-time bus: the wire on any host, or vcan where the kernel has CAN.

Starts wire (if used), recorder, plant, guard, controller, console and planner, shows what they say, plays the operator,
asks the plant for its verdict and ends everything in an order that leaves the valves neutral and the logs complete.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from can_dbc import setpoint
from can_dbc.bus import VCAN_NAMES, kernel_has_can
from can_dbc.timing_page import default_path
from hil.display import Display
from hil.operator import Operator
from hil.processes import Family, free_udp_ports
from host.exits import Exit, Stopped
from machine.faults import describe
from machine.load import profile_hash
from machine.modes import Mode
from machine.profile import Profile

Outcome = TypeVar("Outcome")
HOST: Final = "127.0.0.1"
BITRATES: Final = {"crane0": 1_000_000, "mach0": 250_000}
END_ORDER: Final = ("autonomy", "controller", "guard", "console", "eyes", "plc", "sim", "recorder", "wire")
PORTS: Final = ("control", "planner", "orders", "page", "ticks", "reports", "sim", "pictures")
START_S: Final = 60.0
LOOK_S: Final = 0.1
LAST_WORD_S: Final = 10.0
"""A mission that is broken off waits until crane and machine stand."""
LEASE_MS: Final = 350
"""Longer than the planner's own 200 ms: a bench shares its processor with everything that it emulates."""
HARDWARE_PRIORITY: Final = {"wire": 60, "sim": 50}
"""SCHED_FIFO priorities below those of controller and guard."""
PLANNER_PRIORITY: Final = 20
"""SCHED_FIFO, below everything with a deadline of ms: the fair scheduler of user-mode Linux charges whole ticks to who
wakes with the tick, and let the planner, which does, wait for up to 1.4 s (measured)."""
RECORDER_PRIORITY: Final = 30
"""Before the planner, which can fill every gap of a small host for seconds: the recorder then lost a third of the
frames, the last commands among them (measured).  Its work is bounded by the bus."""
NICENESS: Final = {"console": 10, "eyes": 5}
"""Who only watches can wait; so can the eyes, for the crane stands still while they look."""


def _address(name: str, backend: str) -> str:
    """Where a logical bus is on the chosen backend; "auto" is vcan where it is up, else the wire."""
    match backend:
        case "wire":
            return f"wire:{name}"
        case "vcan":
            return f"socketcan:{VCAN_NAMES[name]}"
        case _:  # an emulated machine never joins a bus that may have a real one
            interfaces = {interface for _, interface in socket.if_nameindex()}
            there = kernel_has_can() and VCAN_NAMES[name] in interfaces
            return _address(name, "vcan" if there else "wire")


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """What a live run is told; ``bus`` is "wire", "vcan" or "auto", ``console_port`` 0 means no page.

    ``plc_link`` is "modbus" or "udp": the way to the PLC of a profile that has one.  ``camera`` names that through
    which logs are seen; without one the plant itself tells where they lie.
    """

    profile_name: str
    profile: Profile
    seed: int
    truth: str
    bus: str
    directory: Path
    console_port: int
    limit_s: float
    patience: int
    plc_link: str = "modbus"
    camera: str = ""


class LiveRun(ABC, Generic[Outcome]):
    """One live run (module docstring: contract); what the job is, a subclass knows."""

    plant_is_told: tuple[object, ...] = ()
    """Further arguments of the plant's process."""
    planner_is_told: tuple[object, ...] = ()
    """Further arguments of the planner's process."""

    def __init__(self, options: LiveOptions, display: Display) -> None:
        self._options = options
        self._display = display
        self._family = Family(options.directory)
        self._profile = ("--profile", options.profile_name)
        # In memory, and of this run alone.
        self._timing = ("--timing", default_path().with_name(f"live-{os.getpid()}.timing"))
        self._report: setpoint.StateReport | None = None
        self._first: setpoint.StateReport | None = None
        self._failure = self._grasp = ""
        self._done = False
        self._outcome: dict[str, Any] = {}
        """The planner's last word."""
        self._operator = Operator(profile_hash(options.profile), self._pressed, options.patience)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.settimeout(0.02)

    def run(self) -> Outcome:
        """Do the job and end every process, whatever happens.

        Raises:
            Stopped: when a process cannot start or dies.
            KeyboardInterrupt: after everything has ended.
        """
        try:
            ports = self._start_all()
            self._follow(ports)
            self._end_planner()
            return self._summary(ports["sim"])
        finally:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)  # the end is bounded; a second Ctrl-C must not break its order
            self._family.stop_all(END_ORDER)
            self._socket.close()

    def _start_all(self) -> dict[str, int]:
        ports = dict(zip(PORTS, free_udp_ports(len(PORTS)), strict=True))
        bus = self._start_bus()
        self._start_machine(bus, ports)
        self._start_people(ports)
        self._start_control(bus, ports)
        return ports

    def _start_bus(self) -> list[str]:
        """The wire where it is used; the bus arguments that every process on it gets."""
        profile = self._options.profile
        buses = [b for b in (profile.crane_bus, profile.machine_bus) if b]
        addresses = [_address(b, self._options.bus) for b in buses]
        if any(address.startswith("wire:") for address in addresses):
            self._start("wire", "hil.wire.daemon", *(x for b in buses for x in ("--bus", f"{b}:{BITRATES[b]}")))
            self._family.await_message("wire", "ready", START_S)
        return [x for b, address in zip(buses, addresses, strict=True) for x in ("--bus", f"{b}={address}")]

    def _start_machine(self, bus: list[str], ports: dict[str, int]) -> None:
        """The emulated hardware, and the recorder that must not miss its first frames.

        On a bench the recorder does not force its data to the disk: inside user-mode Linux the whole kernel would wait
        for the host's disk, and every process with it (tens of ms, measured).
        """
        options = self._options
        self._start(
            "recorder", "recorder", *self._profile, *bus, "--out", options.directory, "--seed", options.seed,
            "--no-sync",
            "--tick-port", ports["ticks"], "--report-port", ports["reports"], *self._timing,
        )  # fmt: skip
        self._family.await_message("recorder", "ready", START_S)
        self._family.hasten("recorder", RECORDER_PRIORITY)
        plant = (*self._profile, "--seed", options.seed, "--truth", options.truth, "--port", ports["sim"])
        if options.profile.plc is None:
            pictures = ("--camera", ports["pictures"]) if options.camera else ()
            self._start("sim", "sim", *plant, *bus, *pictures, *self.plant_is_told)
            self._family.await_message("sim", "ready", START_S)
        else:
            way = f"--{options.plc_link}"
            self._start("sim", "sim.plc", *plant, way, f"{HOST}:0")
            listening = self._family.await_message("sim", "ready", START_S)["ready"]
            self._start("plc", "controller.plc", *self._profile, *bus, way, f"{HOST}:{listening[options.plc_link]}")
            self._family.await_message("plc", "ready", START_S)
            self._display.event(f"a PLC drives the valves: {options.profile.plc.role} over {options.plc_link}")
        # Emulated hardware must answer in time like hardware; controller and guard ask for more by themselves.
        emulated = [name for name in HARDWARE_PRIORITY if name in self._family.children]
        granted = [self._family.hasten(name, HARDWARE_PRIORITY[name]) for name in emulated]
        if not all(granted):
            self._display.event("no real-time priority here: a busy host may stop the machine", "yellow")

    def _start_people(self, ports: dict[str, int]) -> None:
        """Page and planner, before anything has a deadline: their imports keep a small host busy for seconds."""
        options = self._options
        control, scene = f"{HOST}:{ports['control']}", f"{HOST}:{self._start_eyes(ports)}"
        if self._options.console_port:
            self._start(
                "console", "console", *self._profile, "--port", self._options.console_port,
                "--report-port", ports["page"], "--controller", control, "--planner", f"{HOST}:{ports['orders']}",
                "--scene", scene, *self._timing,
            )  # fmt: skip
            url = self._family.await_message("console", "url", START_S)["url"]
            self._display.event(f"watch it at {url}", "bold")
        self._start(
            "autonomy", "autonomy", *self._profile,
            "--controller", control, "--report-port", ports["planner"], "--scene", scene, "--lease-ms", LEASE_MS,
            "--order-port", ports["orders"], *(("--tell", f"{HOST}:{ports['page']}") if options.console_port else ()),
            *self.planner_is_told,
        )  # fmt: skip
        self._family.await_message("autonomy", "event", START_S)
        self._family.hasten("autonomy", PLANNER_PRIORITY)

    def _start_eyes(self, ports: dict[str, int]) -> int:
        """The port at which is told what lies there: the plant's own, or that of the eyes."""
        camera = self._options.camera
        if not camera:
            return ports["sim"]
        frames = f"{HOST}:{ports['pictures']}"
        self._start("eyes", "autonomy.perception", *self._profile, "--camera", camera, "--frames", frames)
        self._display.event(f"the logs are seen through the camera {camera!r}")
        return int(self._family.await_message("eyes", "ready", START_S)["ready"])

    def _start_control(self, bus: list[str], ports: dict[str, int]) -> None:
        self._start("guard", "controller.guard", *self._profile, *bus[:2])  # it judges the crane's bus
        listeners = [self._socket.getsockname()[1], ports["planner"], ports["reports"]]
        listeners += [ports["page"]] if self._options.console_port else []
        self._start(
            "controller", "controller", *self._profile, *bus, "--setpoint-port", ports["control"],
            "--record", f"{HOST}:{ports['ticks']}", *self._timing,
            *(x for port in listeners for x in ("--report", f"{HOST}:{port}")),
        )  # fmt: skip

    def _start(self, name: str, module: str, *arguments: object) -> None:
        self._family.start(name, module, *arguments)
        if name in NICENESS:
            self._family.weigh(name, NICENESS[name])

    def _follow(self, ports: dict[str, int]) -> None:
        """Show and supervise until the planner is through, or a process dies, or time is up."""
        limit = time.monotonic() + self._options.limit_s
        look = 0.0
        while not (self._done or self._failure or self._operator.gave_up):
            if time.monotonic() > limit:
                self._failure = f"not done within {self._options.limit_s:.0f} s"
            self._listen(ports["control"])
            if time.monotonic() < look:
                continue
            look = time.monotonic() + LOOK_S
            gone = self._family.dead()  # before its last words are read
            for name, message in self._family.messages():
                self._heard(name, message)
            if gone and not (gone.name == "autonomy" and (self._done or self._failure)):
                code = gone.process.returncode
                raise Stopped(
                    Exit(code) if code in set(Exit) and code else Exit.SAFETY,
                    f"{gone.name} ended in the middle of the run: {gone.complaint()}",
                )

    def _end_planner(self) -> None:
        """Have a planner that still works end smoothly, and hear its last word."""
        planner = self._family.children["autonomy"].process
        planner.terminate()
        limit = time.monotonic() + LAST_WORD_S
        while not self._outcome and time.monotonic() < limit:
            silent = planner.poll() is not None  # before its last words are read
            for name, message in self._family.messages():
                self._heard(name, message)
            if silent:
                return
            self._family.selector.select(LOOK_S)

    def _listen(self, control_port: int) -> None:
        try:
            message = setpoint.decode(self._socket.recv(2048))
        except (TimeoutError, setpoint.DatagramRefused):
            return
        if not isinstance(message, setpoint.StateReport):
            return
        if self._first is None:
            self._first = message
        if self._report is None or self._report.mode != message.mode:
            self._say_mode(message)
        self._report = message
        self._display.report(message)
        if press := self._operator.step(message):
            self._socket.sendto(press, (HOST, control_port))

    def _say_mode(self, report: setpoint.StateReport) -> None:
        mode = Mode(report.mode)
        if mode in (Mode.STOP, Mode.FAULT):
            self._display.event(f"{mode.name}: {describe(report.reason)}", "yellow")
        else:
            self._display.event(f"controller {mode.name}")

    def _pressed(self, action: setpoint.OperatorAction, _: setpoint.StateReport) -> None:
        self._display.event(f"operator presses {action.name}", "magenta")

    def _heard(self, name: str, message: dict[str, Any]) -> None:
        match name, message.get("event"):
            case "autonomy", "phase":
                self._display.phase(str(message["phase"]))
            case "autonomy", "grasp":
                self._grasp = str(message["reason"])
                self._display.event(f"grasp: {self._grasp}")
            case "autonomy", "done":
                self._done, self._outcome = True, message
            case "autonomy", "failed":
                self._failure = self._failure or str(message["reason"])
                self._outcome = message
            case "autonomy", "refused":
                self._display.event(f"setpoint refused: {describe(int(message['number']))}", "yellow")
            case "eyes", "trouble":
                self._display.event(f"eyes: {message['reason']}", "yellow")
            case "autonomy", "detector":
                self._display.event(f"detector: {message['reason']}", "yellow")

    @abstractmethod
    def _summary(self, sim_port: int) -> Outcome:
        """What it came to; the plant answers at this port."""

    @property
    def _seconds(self) -> float:
        """From the controller's first report to its last."""
        return (self._report.stamp_ns - self._first.stamp_ns) / 1e9 if self._report and self._first else 0.0

    def _ask(self, port: int, op: str) -> dict[str, Any]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(1.0)
            for _ in range(5):
                asking.sendto(json.dumps({"op": op}).encode(), (HOST, port))
                try:
                    answer: dict[str, Any] = json.loads(asking.recv(65536))
                    return answer
                except TimeoutError:
                    continue
        raise Stopped(Exit.CONFIGURATION, "the plant does not answer; see sim.err")
