"""The whole machine as separate processes on a real-time bus: the wire on any host, or vcan where the kernel has CAN.

Starts wire (if used), recorder, plant, guard, controller, console and planner, shows their messages, emulates the
operator, requests the plant's evaluation, and ends the processes in an order that leaves the valves neutral and the
recording complete.
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

from autonomy.crane_job.phases import Phase
from can_dbc.bus.factory import PYTHON_CAN, VCAN_NAMES, kernel_has_can
from can_dbc.messages import datagrams, operator_link
from can_dbc.messages.crane import OperatorAction, StateReport
from can_dbc.messages.envelope import DatagramRefused, read_key, write_key
from can_dbc.timing.page import default_path
from hil.harness.display import Display
from hil.harness.operator import Operator
from hil.harness.processes import ProcessGroup, free_udp_ports
from hil.wire.core import BITRATES
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import profile_check, profile_hash
from machine.profile import Profile
from machine.status.explanation import describe
from machine.status.modes import Mode
from runtime.shared_file import make_own_folder

Outcome = TypeVar("Outcome")
HOST: Final = "127.0.0.1"
END_ORDER: Final = (
    "autonomy",
    "controller",
    "guard",
    "console",
    "faults",
    "detector",
    "plc",
    "sim",
    "recorder",
    "wire",
)
PORTS: Final = ("control", "planner", "orders", "page", "reports", "sim", "pictures", "detector")
ADDRESSES: Final = "live.json"
"""File in the directory of a live run with the ports, the file of its key, buses and process ids."""
AUDIT: Final = "audit.jsonl"
"""File in the same directory: who commanded what on the page."""
START_S: Final = 60.0
"""Patience with a start: a process that cannot start ends at once; on a busy host imports alone take a minute."""
POLL_S: Final = 0.1
PLANNER_END_S: Final = 10.0
"""A planner that is ended early waits until crane and machine stand still."""
HARDWARE_PRIORITY: Final = {"wire": 60, "sim": 50}
"""SCHED_FIFO priorities below those of controller and guard."""
PLANNER_PRIORITY: Final = 20
"""SCHED_FIFO, below every process with deadlines of milliseconds.  The fair scheduler of user-mode Linux charges whole
timer ticks to a process that wakes with the tick, as the planner does, and delayed it by up to 1.4 s (measured)."""
RECORDER_PRIORITY: Final = 30
"""Above the planner, which can occupy a small host for seconds: the recorder then lost a third of the frames, the last
commands among them (measured).  The bus load bounds its work."""
NICENESS: Final = {"console": 10, "faults": 10, "detector": 5}
"""The page can wait; so can the detector, because the crane stands still while it takes pictures."""


def _address(name: str, backend: str) -> str:
    """Return the address of a logical bus on the backend; "auto" is vcan when its interface exists, else the wire."""
    match backend:
        case "wire":
            return f"wire:{name}"
        case "vcan":
            return f"socketcan:{VCAN_NAMES[name]}"
        case "python-can":
            return f"{PYTHON_CAN}socketcan:{VCAN_NAMES[name]}"
        case _:  # never a real interface: an emulated machine must not join a bus with a real one
            interfaces = {interface for _, interface in socket.if_nameindex()}
            there = kernel_has_can() and VCAN_NAMES[name] in interfaces
            return _address(name, "vcan" if there else "wire")


def uses_wire(profile: Profile, backend: str) -> bool:
    """Tell whether a live run of this machine has the wire, in processes of this computer, for its buses."""
    return _address(profile.crane_bus, backend).startswith("wire:")


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Options of a live run; ``bus`` is "wire", "vcan", "python-can" or "auto"; ``console_port`` 0 means no page.

    ``max_stops``: the emulated operator arms again after this many stops.  ``plc_link``, "modbus" or "udp", is used
    when the profile has a PLC.  ``camera`` names the camera that detects the logs; without one the plant reports their
    true poses.  ``foxglove_port`` serves the run to Foxglove and Lichtblick, 0: not.
    """

    profile_name: str
    profile: Profile
    seed: int
    truth: str
    bus: str
    directory: Path
    console_port: int
    limit_s: float
    max_stops: int
    plc_link: str = "modbus"
    camera: str = ""
    foxglove_port: int = 0


class LiveRun(ABC, Generic[Outcome]):
    """One live run, as in the module docstring; a subclass defines the job."""

    plant_arguments: tuple[object, ...] = ()
    """Further arguments of the plant's process."""
    planner_arguments: tuple[object, ...] = ()
    """Further arguments of the planner's process."""
    detector_arguments: tuple[object, ...] = ()
    """Further arguments of the detector's process."""

    def __init__(self, options: LiveOptions, display: Display) -> None:
        self._options = options
        self._display = display
        self._processes = ProcessGroup(options.directory)
        self._profile = ("--profile", options.profile_name)
        # In memory, and private to this run.
        page = default_path().with_name(f"live-{os.getpid()}.timing")
        self._timing, self._ticks = ("--timing", page), page.with_suffix(".ticks")
        self._operators = page.with_suffix(".operator")
        self._desk = page.with_suffix(".faults")
        make_own_folder(page.parent)
        self._key_file = write_key(page.with_suffix(".key"))
        self._key, self._keyed = read_key(self._key_file), ("--key-file", self._key_file)
        self._report: StateReport | None = None
        self._first: StateReport | None = None
        self._failure = self._grasp = ""
        self._closings = 0
        self._done = False
        self._outcome: dict[str, Any] = {}
        """The planner's final message."""
        check = profile_check(options.profile_name)
        self._operator = Operator(profile_hash(options.profile), self._on_press, options.max_stops, False, check)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._socket.settimeout(0.02)

    def run(self) -> Outcome:
        """Run the job; every process ends in any case.

        Raises:
            CommandFailed: a process cannot start or dies.
            KeyboardInterrupt: interrupted; every process has ended.
        """
        try:
            ports = self._start_all()
            self._follow(ports)
            self._end_planner()
            return self._summarize(ports["sim"])
        finally:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, signal.SIG_IGN)  # the end is short; a second Ctrl-C must not disturb it
            self._processes.stop_all(END_ORDER)
            self._socket.close()
            self._remove_shared_files()

    def _remove_shared_files(self) -> None:
        """Remove the key, the guard's latch, and what processes that were killed have left in shared memory."""
        for folder in (self._ticks.parent, operator_link.guard_path(self._operators).parent):
            for path in folder.glob(f"{self._ticks.stem}.*"):
                path.unlink(missing_ok=True)

    def _start_all(self) -> dict[str, int]:
        ports = dict(zip(PORTS, free_udp_ports(len(PORTS)), strict=True))
        bus = self._start_bus()
        self._start_machine(bus, ports)
        self._start_page_and_planner(bus, ports)
        self._start_control(bus, ports)
        self._write_addresses(bus, ports)
        return ports

    def _write_addresses(self, bus: list[str], ports: dict[str, int]) -> None:
        """Tell other processes where this run can be reached (`hil.faults.live`)."""
        document = {
            "profile": self._options.profile_name,
            "ports": ports,
            "key_file": str(self._key_file),
            "buses": dict(b.split("=", 1) for b in bus[1::2]),
            "pids": {name: child.process.pid for name, child in self._processes.children.items()},
        }
        (self._options.directory / ADDRESSES).write_text(json.dumps(document, indent=2))

    def _start_bus(self) -> list[str]:
        """Start the wire where it is used; return the bus arguments of every process."""
        profile = self._options.profile
        buses = [b for b in (profile.crane_bus, profile.machine_bus) if b]
        addresses = [_address(b, self._options.bus) for b in buses]
        if any(address.startswith("wire:") for address in addresses):
            self._start("wire", "hil.wire.daemon", *(x for b in buses for x in ("--bus", f"{b}:{BITRATES[b]}")))
            self._processes.await_message("wire", "ready", START_S)
        return [x for b, address in zip(buses, addresses, strict=True) for x in ("--bus", f"{b}={address}")]

    def _start_machine(self, bus: list[str], ports: dict[str, int]) -> None:
        """Start the recorder, which must not miss the first frames, and the emulated hardware.

        On a bench the recorder does not force its data to disk: inside user-mode Linux the whole kernel would wait for
        the host's disk, and every process with it (tens of ms, measured).
        """
        options = self._options
        self._start(
            "recorder",
            "recorder",
            *self._profile,
            *bus,
            "--out",
            options.directory,
            "--seed",
            options.seed,
            "--no-sync",
            "--ticks",
            self._ticks,
            "--report-port",
            ports["reports"],
            *self._timing,
            *self._keyed,
            *(("--pictures", f"{HOST}:{ports['detector']}") if options.camera else ()),
        )
        self._processes.await_message("recorder", "ready", START_S)
        self._processes.set_fifo_priority("recorder", RECORDER_PRIORITY)
        plant = (*self._profile, "--seed", options.seed, "--truth", options.truth, "--port", ports["sim"])
        pictures = ("--camera", ports["pictures"]) if options.camera else ()
        if options.profile.plc is None:
            self._start("sim", "sim", *plant, *bus, *pictures, *self.plant_arguments)
            self._processes.await_message("sim", "ready", START_S)
        else:
            link = f"--{options.plc_link}"
            self._start("sim", "sim.plc", *plant, link, f"{HOST}:0", *pictures)
            listening = self._processes.await_message("sim", "ready", START_S)["ready"]
            self._start("plc", "controller.plc", *self._profile, *bus, link, f"{HOST}:{listening[options.plc_link]}")
            self._processes.await_message("plc", "ready", START_S)
            self._display.event(f"a PLC drives the valves: {options.profile.plc.role} over {options.plc_link}")
        # Emulated hardware must answer in time, like hardware; controller and guard raise their own priority.
        emulated = [name for name in HARDWARE_PRIORITY if name in self._processes.children]
        granted = [self._processes.set_fifo_priority(name, HARDWARE_PRIORITY[name]) for name in emulated]
        if not all(granted):
            self._display.event(
                "no real-time priority on this host: the machine may stop when the host is busy", "yellow"
            )

    def _start_page_and_planner(self, bus: list[str], ports: dict[str, int]) -> None:
        """Start them before any process has a deadline: their imports load a small host for seconds."""
        options = self._options
        control, scene = f"{HOST}:{ports['control']}", f"{HOST}:{self._start_detector(ports)}"
        if self._options.console_port:
            self._start("faults", "hil.faults", "--run", options.directory, "--socket", self._desk)
            self._processes.await_message("faults", "ready", START_S)
            self._start(
                "console",
                "console",
                *self._profile,
                "--port",
                self._options.console_port,
                "--report-port",
                ports["page"],
                "--operator",
                self._operators,
                "--planner",
                f"{HOST}:{ports['orders']}",
                "--scene",
                scene,
                *self._timing,
                *self._keyed,
                *bus,
                "--faults",
                self._desk,
                "--missions",
                "missions",
                "--truth",
                f"{HOST}:{ports['sim']}",
                *(("--foxglove", options.foxglove_port) if options.foxglove_port else ()),
                "--audit",
                options.directory / AUDIT,
                "--recording",
                options.directory,
                "--controller",
                control,
                "--commission",
                options.directory / "commissioning",
            )
            served = self._processes.await_message("console", "url", START_S)
            self._display.event(f"operator's page: {served['url']}", "bold")
            if "foxglove" in served:
                self._display.event(f"Foxglove or Lichtblick: {served['foxglove']}", "bold")
        listener_ports = [ports["page"]] if options.console_port else []
        # The recorder keeps the log map.
        listener_ports += [ports["reports"]] if options.profile.carrier is not None else []
        self._start(
            "autonomy",
            "autonomy",
            *self._profile,
            "--controller",
            control,
            "--report-port",
            ports["planner"],
            "--scene",
            scene,
            "--order-port",
            ports["orders"],
            *self._keyed,
            *(x for port in listener_ports for x in ("--tell", f"{HOST}:{port}")),
            *self.planner_arguments,
        )
        self._processes.await_message("autonomy", "event", START_S)
        self._processes.set_fifo_priority("autonomy", PLANNER_PRIORITY)

    def _start_detector(self, ports: dict[str, int]) -> int:
        """Start the detector of a camera, if any; return the UDP port for the list of logs: its own, or the plant's."""
        camera = self._options.camera
        if not camera:
            return ports["sim"]
        frames = f"{HOST}:{ports['pictures']}"
        self._start(
            "detector",
            "autonomy.perception",
            *self._profile,
            "--camera",
            camera,
            "--frames",
            frames,
            "--port",
            ports["detector"],
            *self.detector_arguments,
        )
        self._display.event(f"camera {camera!r} detects the logs")
        return int(self._processes.await_message("detector", "ready", START_S)["ready"])

    def _start_control(self, bus: list[str], ports: dict[str, int]) -> None:
        latch = self._ticks.with_suffix(".latched")
        self._start("guard", "controller.guard", *self._profile, *bus, "--state", latch, "--operator", self._operators)
        listeners = [self._socket.getsockname()[1], ports["planner"], ports["reports"]]
        listeners += [ports["page"]] if self._options.console_port else []
        self._start(
            "controller",
            "controller",
            *self._profile,
            *bus,
            "--setpoint-port",
            ports["control"],
            "--operator",
            self._operators,
            "--record",
            self._ticks,
            *self._timing,
            *self._keyed,
            *(x for port in listeners for x in ("--report", f"{HOST}:{port}")),
        )

    def _start(self, name: str, module: str, *arguments: object) -> None:
        self._processes.start(name, module, *arguments)
        if name in NICENESS:
            self._processes.set_niceness(name, NICENESS[name])

    def _follow(self, ports: dict[str, int]) -> None:
        """Show and supervise until the planner is done, a process dies, or the time is up."""
        limit = time.monotonic() + self._options.limit_s
        poll_s = 0.0
        while not (self._done or self._failure or self._operator.gave_up):
            if time.monotonic() > limit:
                self._failure = f"not done within {self._options.limit_s:.0f} s"
            self._receive()
            if time.monotonic() < poll_s:
                continue
            poll_s = time.monotonic() + POLL_S
            gone = self._processes.dead()  # before its last messages are read
            for name, message in self._processes.messages():
                self._on_message(name, message)
            if gone and not (gone.name == "autonomy" and (self._done or self._failure)):
                code = gone.process.returncode
                raise CommandFailed(
                    "live.process-ended",
                    f"{gone.name} ended during the run: {gone.complaint()}",
                    ExitCode(code) if code in set(ExitCode) and code else ExitCode.SAFETY_STOP,
                )
        self._failure = self._failure or self._operator.complaint

    def _end_planner(self) -> None:
        """End a planner that still works, and wait for its final message."""
        planner = self._processes.children["autonomy"].process
        planner.terminate()
        limit = time.monotonic() + PLANNER_END_S
        while not self._outcome and time.monotonic() < limit:
            ended = planner.poll() is not None  # before its last messages are read
            for name, message in self._processes.messages():
                self._on_message(name, message)
            if ended:
                return
            self._processes.selector.select(POLL_S)

    def _receive(self) -> None:
        try:
            message = datagrams.decode(self._socket.recv(2048), self._key)
        except (TimeoutError, DatagramRefused):
            return
        if not isinstance(message, StateReport):
            return
        if self._first is None:
            self._first = message
        if self._report is None or self._report.mode != message.mode:
            self._show_mode(message)
        self._report = message
        self._display.report(message)
        if press := self._operator.step(message):
            operator_link.send(press, self._operators)

    def _show_mode(self, report: StateReport) -> None:
        mode = Mode(report.mode)
        if mode in (Mode.STOP, Mode.FAULT):
            self._display.event(f"{mode.name}: {describe(report.reason, numbers=report.numbers)}", "yellow")
        else:
            self._display.event(f"controller {mode.name}")

    def _on_press(self, action: OperatorAction, _: StateReport) -> None:
        self._display.event(f"operator presses {action.name}", "magenta")

    def _on_message(self, name: str, message: dict[str, Any]) -> None:
        match name, message.get("event"):
            case "autonomy", "phase":
                self._display.phase(str(message["phase"]))
                self._closings += message["phase"] == Phase.CLOSE.name
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
            case "detector", "trouble":
                self._display.event(f"detector: {message['reason']}", "yellow")
            case "autonomy", "detector":
                self._display.event(f"detector: {message['reason']}", "yellow")

    @abstractmethod
    def _summarize(self, sim_port: int) -> Outcome:
        """Summarize the outcome of the run; the plant answers requests at ``sim_port``."""

    @property
    def _seconds(self) -> float:
        """From the controller's first report to its last."""
        return (self._report.stamp_ns - self._first.stamp_ns) / 1e9 if self._report and self._first else 0.0

    def _request(self, port: int, op: str) -> dict[str, Any]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(1.0)
            for _ in range(5):
                client.sendto(json.dumps({"op": op}).encode(), (HOST, port))
                try:
                    answer: dict[str, Any] = json.loads(client.recv(65536))
                    return answer
                except TimeoutError:
                    continue
        raise CommandFailed(
            "live.plant-silent", "the plant does not answer; see sim.err in the run's directory", ExitCode.CONFIGURATION
        )
