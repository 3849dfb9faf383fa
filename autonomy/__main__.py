"""The planning process: controller reports and log lists in, setpoints out, phase changes as JSON lines.

``python -m autonomy --profile palms_471 --controller 127.0.0.1:47001 --report-port 47002 --scene 127.0.0.1:47003``
lays one log into the bunk; with ``--mission FILE`` and a machine that drives, the whole mission is done.
``--tell HOST:PORT`` is told twice a second how the mission stands, and ``--order-port`` takes a person's orders
(`can_dbc.messages.mission` has both), from this machine only.
``--progress FILE`` keeps how far the mission has come; where there is such a file already the mission goes on from
there, once a person has ordered Auto.

Events on stdout: ``phase``, ``grasp`` (the logs that are to come up, why they and with what probability), ``paused``
(with its reason), ``running``, ``refused`` (a setpoint, with the controller's number), of a mission ``state`` and
``load`` (logs on board), ``order`` (a person's, and why it is refused), ``resumed`` (with what was done before),
``progress`` (why it cannot be kept), ``done``, ``failed`` (with its reason).
SIGTERM and SIGINT stop crane and machine smoothly and end with a hold.
Exit codes: 0 the log lies in the bunk or the mission is finished, 2 usage, 3 profile, mission, progress or key, 4 port,
5 interrupted while the controller was stopped, 6 the job failed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from autonomy.crane_job.activity import Activity
from autonomy.grasp.selection import PlannerSelection
from autonomy.grasp.pile_planner import PilePlanner
from autonomy.grasp.sampling_planner import SamplingPlanner
from autonomy.manager.checkpoint_file import Logbook, MissionFinished, read
from autonomy.manager.activity_manager import Manager
from autonomy.manager.transition_table import WAYS
from autonomy.missions.crane_job import Mission
from autonomy.missions.mission_file import load_mission
from autonomy.missions.model import MissionError
from autonomy.perception.log_list.datagrams import LogListError, decode_logs, encode_request
from autonomy.perception.log_list.observation import LogObservation
from autonomy.process.jobs import Forwarding, Job, OneLog
from autonomy.process.operator_commands import OrderRefused, Orders
from can_dbc.messages.mission import encode_mission
from can_dbc.messages.crane import StateReport
from can_dbc.messages.udp_address import udp_address
from can_dbc.messages.datagrams import decode
from can_dbc.messages.vehicle import VehicleReport
from can_dbc.messages.envelope import DatagramRefused
from machine.loading.profile_file import ProfileError, load_profile, profile_hash
from machine.status.modes import Mode
from machine.profile import Profile

FINE, CONFIGURATION, BUSY, SAFETY, FAILED, INTERRUPTED = 0, 3, 4, 5, 6, 130
TURN_S: Final = 0.01
LOOK_NS: Final = 250_000_000
TELL_NS: Final = 500_000_000
NOT_PAUSED: Final = {"reason": None}
Address = tuple[str, int]


def address(text: str) -> Address:
    """HOST:PORT of a command line; raises ArgumentTypeError."""
    try:
        return udp_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def arguments(argv: list[str]) -> argparse.Namespace:
    """The command line; ends the process with code 2 when it is wrong."""
    parser = argparse.ArgumentParser(prog="python -m autonomy", description="Picks one log, or does a mission.")
    parser.add_argument("--profile", default="palms_471", help="shipped name or TOML file of the machine")
    parser.add_argument("--controller", type=address, required=True, help="HOST:PORT that takes setpoints")
    parser.add_argument("--report-port", type=int, required=True, help="local UDP port for state reports")
    parser.add_argument("--scene", type=address, required=True, help="HOST:PORT of the log detector")
    parser.add_argument("--log", type=int, help="number of the log to pick (default: the best one)")
    parser.add_argument("--mission", type=Path, help="file of a mission to do, in any format of `timberhand plan`")
    parser.add_argument("--progress", type=Path, help="file that keeps how far the mission has come, to go on from")
    parser.add_argument("--way", choices=WAYS, default="ours", help="whose way the mission is done")
    parser.add_argument("--tell", type=address, action="append", default=[], help="HOST:PORT to tell of the mission")
    parser.add_argument("--order-port", type=int, help="local UDP port for a person's orders to the mission")
    parser.add_argument("--lease-ms", type=int, default=200, help="how long a setpoint is obeyed")
    parser.add_argument("--key-file", type=Path, help="file with the key that authenticates datagrams")
    options = parser.parse_args(argv)
    if options.progress is not None and (options.mission is None or options.order_port is None):
        parser.error("--progress needs --mission, and --order-port: a mission that goes on waits for a person's order")
    return options


class Process:
    """The sockets around a job."""

    def __init__(self, job: Job, profile_hash: int, options: argparse.Namespace, key: bytes | None = None) -> None:
        self._key = key
        self.signals: list[int] = []
        self.foreign = False
        self._job = job
        self._hash = profile_hash
        self._controller: Address = options.controller
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind(("127.0.0.1", options.report_port))
        self._scene = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._scene.connect(options.scene)
        self._orders = Orders(profile_hash, key)
        self._ordered = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if options.order_port is not None:
            self._ordered.bind(("127.0.0.1", options.order_port))
        self._watchers: list[Address] = options.tell
        self._logbook = None if options.progress is None else Logbook(options.progress)
        self._sequence = 0
        for each in (self._link, self._scene, self._ordered):
            each.setblocking(False)
        self._look_ns = self._tell_ns = 0
        self._mode = -1
        self._joints: tuple[float, ...] = ()
        self._told: dict[str, object] = {}

    def close(self) -> None:
        """Gives the ports back."""
        for each in (self._link, self._scene, self._ordered):
            each.close()

    @property
    def stopped(self) -> bool:
        """Whether the controller's last word was STOP or FAULT."""
        return self._mode in (Mode.STOP, Mode.FAULT)

    def run(self) -> None:
        """Turns until the job has nothing more to send."""
        while not self._job.idle and not self.foreign:
            select.select([self._link, self._scene, self._ordered], [], [], TURN_S)
            if self.signals:
                self._job.abort(f"ended by {signal.Signals(self.signals[0]).name}")
            self.turn(time.monotonic_ns())
        self._report_mission(time.monotonic_ns())
        self._keep_on(time.monotonic_ns())

    def turn(self, now_ns: int) -> None:
        """One turn: ask, take what came, step, send, tell."""
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + LOOK_NS
            self._send(self._scene.send, encode_request(self._joints))
        self._obey(now_ns)
        (report, vehicle), logs = self._newest_reports(), self._newest_logs()
        for data in self._job.step(now_ns, report, vehicle, logs):
            self._send(lambda d: self._link.sendto(d, self._controller), data)
        self._tell(report)
        if now_ns >= self._tell_ns:
            self._tell_ns = now_ns + TELL_NS
            self._report_mission(now_ns)
        if self._logbook is not None and self._logbook.due(now_ns):
            self._keep_on(now_ns)

    def keep(self, now_ns: int) -> None:
        """The progress into its file; raises OSError."""
        progress = self._job.progress()
        if self._logbook is not None and progress is not None:
            self._logbook.keep(progress, now_ns, time.time_ns())

    def _keep_on(self, now_ns: int) -> None:
        """A disk that takes no more does not stop a machine that works."""
        try:
            self.keep(now_ns)
        except OSError as error:
            trouble = f"the progress cannot be kept: {error.strerror}"
            if self._changed("progress", trouble):
                say("progress", reason=trouble)

    def _obey(self, now_ns: int) -> None:
        """Do what a person orders, and say so."""
        for data in _received(self._ordered):
            try:
                order = self._orders.take(data, now_ns)
            except OrderRefused as error:
                say("order", order=None, refused=str(error))
                continue
            refused = self._job.obey(order)
            say("order", order=order.order.name, refused=refused or None)
            self._tell_ns = 0  # who has ordered it sees at once what comes of it

    def _report_mission(self, now_ns: int) -> None:
        report = self._job.report(now_ns) if self._watchers else None
        if report is None:
            return
        self._sequence += 1
        data = encode_mission(report, self._sequence, self._hash, now_ns, self._key)
        for watcher in self._watchers:
            self._send(lambda d, to=watcher: self._link.sendto(d, to), data)

    def _newest_reports(self) -> tuple[StateReport | None, VehicleReport | None]:
        newest, vehicle = None, None
        for data in _received(self._link):
            try:
                message = decode(data, self._key)
            except DatagramRefused:
                continue
            if not isinstance(message, StateReport | VehicleReport):
                continue
            if message.profile_hash != self._hash:
                self.foreign = True
                return None, None
            if isinstance(message, VehicleReport):
                vehicle = message
            else:
                newest, self._mode, self._joints = message, message.mode, message.position
        return newest, vehicle

    def _newest_logs(self) -> tuple[LogObservation, ...]:
        logs: tuple[LogObservation, ...] = ()
        for data in _received(self._scene):
            try:
                logs = decode_logs(data)
            except LogListError as error:
                if self._changed("detector", str(error)):
                    say("detector", reason=str(error))
        return logs

    @staticmethod
    def _send(send: Callable[[bytes], int], data: bytes) -> None:
        # Nobody listens yet, or the buffer is full: the next one follows in 50 ms.
        with suppress(ConnectionRefusedError, BlockingIOError):
            send(data)

    def _tell(self, report: StateReport | None) -> None:
        """Says what is not as it was in the last turn."""
        for event, what in self._job.news():
            if self._changed(event, what):
                say("running" if what == NOT_PAUSED else event, **what)
        if report is not None and self._changed("refused", report.refused) and report.refused:
            say("refused", number=report.refusal, count=report.refused)

    def _changed(self, name: str, value: object) -> bool:
        before = self._told.get(name)
        self._told[name] = value
        return value != before


def say(event: str, **what: object) -> None:
    """One JSON line on stdout."""
    line = {"event": event, "t_s": round(time.monotonic(), 3), **{k: v for k, v in what.items() if v is not None}}
    sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
    sys.stdout.flush()


def _received(link: socket.socket) -> list[bytes]:
    found = []
    while True:
        try:
            found.append(link.recv(65535))
        except BlockingIOError:
            return found
        except ConnectionRefusedError:
            continue


def main(argv: list[str] | None = None) -> int:
    """Runs one mission; the exit code."""
    options = arguments(sys.argv[1:] if argv is None else argv)
    try:
        profile = load_profile(options.profile)
    except ProfileError as error:
        return _complain(str(error))
    if not 0 < options.lease_ms <= profile.timeouts.lease_max_ms:
        return _complain(f"--lease-ms {options.lease_ms}: {profile.name} allows 1..{profile.timeouts.lease_max_ms}")
    try:
        key = options.key_file.read_bytes().strip() if options.key_file else None
    except OSError as error:
        return _complain(f"{options.key_file}: the key cannot be read: {error.strerror}")
    lease_ns = options.lease_ms * 1_000_000
    try:
        job = _job(options, profile, lease_ns, key)
    except MissionError as error:
        return _complain(str(error))
    except MissionFinished as told:
        say("done", reason=str(told))
        return FINE
    try:
        process = Process(job, profile_hash(profile), options, key)
    except (OSError, OverflowError) as error:
        ports = f"{options.report_port}" + (f" or {options.order_port}" if options.order_port is not None else "")
        return _complain(f"UDP port {ports} cannot be opened ({error}); choose another one", BUSY)
    try:
        process.keep(time.monotonic_ns())
    except OSError as error:
        process.close()
        return _complain(f"{options.progress}: the progress cannot be kept there: {error.strerror}")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: process.signals.append(number))
    try:
        process.run()
    finally:
        process.close()
    if process.foreign:
        return _complain("the controller runs another profile than this planner: start both with the same one")
    if job.done:
        say("done", **job.outcome())
        return FINE
    say("failed", reason=job.failure, **job.outcome())
    if not process.signals:
        return FAILED
    return SAFETY if process.stopped else INTERRUPTED


def _job(options: argparse.Namespace, profile: Profile, lease_ns: int, key: bytes | None) -> Job:
    """What the command line asks for; raises MissionError, MissionFinished."""
    code, chooser = profile_hash(profile), PlannerSelection(SamplingPlanner())
    if options.mission is None:
        return OneLog(Activity(profile, code, Mission(log_id=options.log), lease_ns, key, chooser))
    if profile.carrier is None:
        raise MissionError(f"{profile.name} stands still; a mission needs a machine that drives, such as aoro_fc8")
    site = (profile.carrier.site_lat_deg, profile.carrier.site_lon_deg)
    mission = load_mission(options.mission, route_wanted=True, site=site).mission
    progress = options.progress and read(options.progress, mission, time.monotonic_ns(), time.time_ns())
    manager = Manager(
        profile, code, mission, WAYS[options.way], chooser, key=key, lease_ns=lease_ns,
        emptier=PlannerSelection(PilePlanner(SamplingPlanner())), progress=progress,
    )  # fmt: skip
    if progress:
        tally = manager.tally
        say("resumed", loaded=tally.loaded, on_board=tally.on_board, loads=len(tally.loads))
    return Forwarding(manager, mission)


def _complain(sentence: str, code: int = CONFIGURATION) -> int:
    sys.stderr.write(f"{sentence}\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
