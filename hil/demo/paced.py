"""The one-log job in paced virtual time: the lockstep run, no faster than the wall clock, with the operator's page.

For a computer that does not hold the period of a live run: what it loses, the whole run loses, and nothing stops for
it.  Processes, bus and plant are those of `hil.demo.lockstep`, and while nobody presses a button of the page a seed
leaves the same bytes.  Of the page all that needs a further process is left out: planner's orders, CAN table, timing,
faults, commissioning.  Nor are its heartbeats passed on: they come by the wall clock, and a page that this computer
delays must not stop the crane.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from rich.console import Console

from autonomy.crane_job.activity import Activity
from autonomy.grasp.planners import OUR_PLANNER, PlannerChoice
from autonomy.perception.log_list import LogObservation, decode_request, encode_error, encode_logs
from autonomy.process.mission_publisher import chosen_grasp
from can_dbc.messages import operator_link
from can_dbc.messages.crane import WATCH_ACTIONS, OperatorCommand, StateReport
from can_dbc.messages.datagrams import decode, encode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import encode_grasp
from can_dbc.messages.vehicle import VehicleReport
from controller.process.operator_socket import OperatorSocket
from controller.process.realtime import sleep_until
from controller.tick import Outputs
from hil.demo.lockstep import run_lockstep
from hil.demo.summary import Summary
from hil.harness.display import Display
from hil.harness.live import AUDIT, HOST, NICENESS, START_S
from hil.harness.lockstep import Lockstep, true_logs
from hil.harness.processes import ProcessGroup, free_udp_ports
from host.exit_codes import CommandFailed, ExitCode
from machine.loading.profile_file import load_profile, profile_hash
from runtime.errors import InputRefused

SLACK_NS: Final = 20_000_000
"""A smaller delay is made up for unseen: the page draws every 50 ms."""
SHOW_NS: Final = 500_000_000
"""Period of the chosen grasp on the page, as in a live run, and of the look at the page's process."""
REQUEST_BYTES: Final = 2048
_STAMPS: Final = {
    StateReport: ("stamp_ns", "since_ns"),
    VehicleReport: ("stamp_ns", "position_ns", "heading_ns", "motion_ns"),
}


class Pace:
    """Holds virtual time back to the clock of this computer; what is lost is never made up for.

    ``offset_ns``: what the clock is ahead of virtual time; ``behind_ns``: what was lost.
    """

    def __init__(
        self, clock_ns: Callable[[], int] = time.monotonic_ns, sleep: Callable[[int], None] = sleep_until
    ) -> None:
        self._clock_ns, self._sleep = clock_ns, sleep
        self.offset_ns = self.behind_ns = 0

    def begin(self, now_ns: int) -> None:
        """Set virtual time to ``now_ns``, and let it go on from here."""
        self.offset_ns = self._clock_ns() - now_ns

    def hold(self, now_ns: int) -> None:
        """Sleep until the clock has come to the virtual time ``now_ns``."""
        late_ns = self._clock_ns() - (now_ns + self.offset_ns)
        if late_ns < 0:
            self._sleep(now_ns + self.offset_ns)
        elif late_ns > SLACK_NS:
            self.offset_ns += late_ns
            self.behind_ns += late_ns


def in_virtual_time(command: bytes, offset_ns: int, now_ns: int) -> bytes | None:
    """Put the stamp of an operator's command on the clock of the run, now ``now_ns``; return None for a heartbeat.

    While the computer stood still, so did the run: a command from then is not from the future.  What is no command is
    left to the controller's gate.
    """
    try:
        message = decode(command)
    except DatagramRefused:
        return command
    if not isinstance(message, OperatorCommand):
        return command
    if message.action in WATCH_ACTIONS:
        return None
    return encode(replace(message, stamp_ns=max(0, min(message.stamp_ns - offset_ns, now_ns))))


def in_real_time(report: bytes, offset_ns: int) -> bytes:
    """Put the stamps of a controller's report on the clock of this computer; a stamp of 0 means never."""
    message = decode(report)
    assert isinstance(message, StateReport | VehicleReport)
    names = _STAMPS[type(message)]
    return encode(replace(message, **{n: at_ns + offset_ns for n in names if (at_ns := getattr(message, n))}))


class PageLink:
    """What goes between the page and the run: commands, reports, the logs and the chosen grasp.  Never blocks.

    ``operator``: path of the socket for commands; ``report_port``: where the page hears reports.
    """

    def __init__(self, operator: Path, report_port: int, profile_hash: int) -> None:
        self._commands = OperatorSocket(operator)
        self._reports, self._scene = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._scene.bind((HOST, 0))
        self._scene.setblocking(False)
        self._reports.setblocking(False)
        self._to = (HOST, report_port)
        self._hash = profile_hash
        self._waiting: list[bytes] = []
        self._sequence = 0

    @property
    def scene_port(self) -> int:
        """UDP port that answers requests for the list of logs."""
        return int(self._scene.getsockname()[1])

    def close(self) -> None:
        """Close the sockets."""
        self._commands.close()
        self._reports.close()
        self._scene.close()

    def commands(self, offset_ns: int, now_ns: int) -> list[bytes]:
        """Return the commands that wait, in virtual time."""
        self._waiting.clear()
        self._commands.receive(self._waiting, [])
        translated = (in_virtual_time(command, offset_ns, now_ns) for command in self._waiting)
        return [command for command in translated if command is not None]

    def answer(self, logs: Callable[[], tuple[LogObservation, ...]]) -> None:
        """Answer a request for the list of logs."""
        with contextlib.suppress(OSError):
            data, sender = self._scene.recvfrom(REQUEST_BYTES)
            try:
                decode_request(data)
            except InputRefused as error:
                self._scene.sendto(encode_error(str(error)), sender)
            else:
                self._scene.sendto(encode_logs(logs()), sender)

    def tell(self, outputs: Outputs, offset_ns: int) -> None:
        """Pass the controller's reports on."""
        for report in (outputs.report, outputs.vehicle_report):
            if report is not None:
                self._send(in_real_time(report, offset_ns))

    def tell_grasp(self, activity: Activity, now_ns: int) -> None:
        """Pass the chosen grasp on, if there is one; ``now_ns`` is real."""
        grasp = chosen_grasp(activity)
        if grasp is not None:
            self._sequence += 1
            self._send(encode_grasp(grasp, self._sequence, self._hash, now_ns))

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # the page has ended, or is slow: it only shows
            self._reports.sendto(data, self._to)


class Paced:
    """Goes along with a run (`hil.demo.lockstep.Companion`): the pace, and the page where there is one.

    ``start`` starts the page's process, ``check`` looks at it.
    """

    def __init__(
        self,
        pace: Pace,
        page: PageLink | None = None,
        camera: bool = False,
        start: Callable[[Display], None] = lambda _: None,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._pace, self._page, self._camera = pace, page, camera
        self._start, self._check = start, check
        self._activity: Activity | None = None
        self._show_ns = 0

    def begin(self, system: Lockstep, activity: Activity, display: Display) -> None:
        """Start the page, which takes seconds, and then the clock."""
        self._activity = activity
        self._start(display)
        self._pace.begin(system.now_ns)

    def go_along(self, system: Lockstep) -> None:
        """Serve the page and wait for the clock."""
        pace, page, now_ns = self._pace, self._page, system.now_ns
        if page is not None:  # before the pace gives up lost time, in which a command may have been sent
            for command in page.commands(pace.offset_ns, now_ns):
                system.press(command)
            page.answer(lambda: system.logs if self._camera else true_logs(system.plant))
            if now_ns >= self._show_ns and self._activity is not None:
                self._show_ns = now_ns + SHOW_NS
                page.tell_grasp(self._activity, now_ns + pace.offset_ns)
                self._check()
        pace.hold(now_ns)

    def on_outputs(self, outputs: Outputs, _: int) -> None:
        """Show the reports of a tick on the page."""
        if self._page is not None:
            self._page.tell(outputs, self._pace.offset_ns)


def run_paced(
    name: str,
    seed: int,
    truth: str,
    directory: Path,
    page: int,
    limit_s: float,
    max_stops: int,
    console: Console,
    camera: str = "",
    foxglove_port: int = 0,
    planner: PlannerChoice = OUR_PLANNER,
) -> Summary:
    """Run the job in paced virtual time; ``page`` is the port of the operator's page, 0: none.

    Raises:
        CommandFailed: as `run_lockstep`; or the page cannot start, or ends.
    """
    pace, processes = Pace(), ProcessGroup(directory)
    with contextlib.ExitStack() as stack:
        companion = Paced(pace)
        if page:
            operator = operator_link.default_path().with_name(f"paced-{os.getpid()}.operator")
            (reports,) = free_udp_ports(1)
            link = PageLink(operator, reports, profile_hash(load_profile(name)))
            stack.callback(link.close)
            stack.callback(_end, processes)

            def start(display: Display) -> None:
                processes.start(
                    "console",
                    "console",
                    "--profile",
                    name,
                    "--port",
                    page,
                    "--report-port",
                    reports,
                    "--operator",
                    operator,
                    "--scene",
                    f"{HOST}:{link.scene_port}",
                    *(("--foxglove", foxglove_port) if foxglove_port else ()),
                    "--missions",
                    "missions",
                    "--audit",
                    directory / AUDIT,
                    "--recording",
                    directory,
                )
                processes.set_niceness("console", NICENESS["console"])
                served = processes.await_message("console", "url", START_S)
                display.event(f"operator's page: {served['url']}", "bold")
                if "foxglove" in served:
                    display.event(f"Foxglove or Lichtblick: {served['foxglove']}", "bold")

            companion = Paced(pace, link, bool(camera), start, lambda: _check(processes))
        summary = run_lockstep(
            name,
            seed,
            truth,
            directory,
            limit_s,
            console,
            camera,
            max_stops=max_stops,
            companion=companion,
            planner=planner,
        )
        return replace(summary, paced=True, behind_s=pace.behind_ns / 1e9)


def _check(processes: ProcessGroup) -> None:
    if gone := processes.dead():
        raise CommandFailed(
            "paced.process-ended", f"{gone.name} ended during the run: {gone.complaint()}", ExitCode.SAFETY_STOP
        )


def _end(processes: ProcessGroup) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the end is short; a second Ctrl-C must not disturb it
    processes.stop_all(("console",))
