"""The sockets round a job: receives reports, log lists and operator commands; sends setpoints, mission reports and the
chosen grasp.

`PlannerProcess.run` steps the job at 100 Hz or faster until it is idle.  A detector or controller that does not listen
is not an error; a checkpoint that cannot be written is emitted as an event and does not stop the machine.
"""

from __future__ import annotations

import argparse
import select
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import msgspec

from autonomy.manager.checkpoint import CheckpointFile
from autonomy.missions.model import MissionError
from autonomy.perception.log_list import LogObservation, decode_logs, encode_request
from autonomy.process.command_line import Address, emit
from autonomy.process.jobs import Job
from autonomy.process.mission_publisher import short_text
from autonomy.process.operator_commands import CommandReceiver, CommandRefused
from autonomy.process.upload import MachineAtRest, UploadedMissions
from can_dbc.messages.crane import StateReport
from can_dbc.messages.datagrams import decode
from can_dbc.messages.envelope import DatagramRefused
from can_dbc.messages.mission import MissionUpload, encode_grasp, encode_mission
from can_dbc.messages.vehicle import VehicleReport
from machine.status.modes import Mode
from machine.status.reasons import Reason
from runtime.errors import InputRefused

STEP_S: Final = 0.01
REQUEST_PERIOD_NS: Final = 250_000_000
"""Period of the requests for log lists."""
REPORT_PERIOD_NS: Final = 500_000_000
"""Period of the mission reports."""
NOT_PAUSED: Final = {"reason": None}


class PlannerProcess:
    """Runs one job.  ``signals`` are the signals received, ``foreign`` whether the controller has another profile.

    ``uploads`` makes a job of an uploaded mission, None refuses it.
    """

    def __init__(
        self,
        job: Job,
        profile_hash: int,
        options: argparse.Namespace,
        key: bytes | None = None,
        uploads: UploadedMissions | None = None,
    ) -> None:
        self._key = key
        self.signals: list[int] = []
        self.foreign = False
        self._job = job
        self._hash = profile_hash
        self._controller: Address = options.controller
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.bind(("127.0.0.1", options.report_port))
        self._detector = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._detector.connect(options.scene)
        self._receiver = CommandReceiver(profile_hash, key)
        self._commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if options.order_port is not None:
            self._commands.bind(("127.0.0.1", options.order_port))
        self._watchers: list[Address] = options.tell
        self._checkpoint_file = None if options.progress is None else CheckpointFile(options.progress)
        self._sequence = 0
        for each in (self._link, self._detector, self._commands):
            each.setblocking(False)
        self._request_ns = self._report_ns = 0
        self._uploads, self._machine = uploads, MachineAtRest()
        self._answer: dict[str, Any] = {}
        self._askers: list[Address] = []
        """Who sent the commands that have not been answered yet."""
        self._joints: tuple[float, ...] = ()
        self._emitted: dict[str, object] = {}

    def close(self) -> None:
        """Close the sockets."""
        for each in (self._link, self._detector, self._commands):
            each.close()

    @property
    def job(self) -> Job:
        """The job: the first one, or that of the mission that was uploaded last."""
        return self._job

    @property
    def stopped(self) -> bool:
        """Whether the controller's last report was in STOP or FAULT."""
        return self._machine.mode in (Mode.STOP, Mode.FAULT)

    def run(self) -> None:
        """Step the job until it is idle."""
        while not self._job.idle and not self.foreign:
            select.select([self._link, self._detector, self._commands], [], [], STEP_S)
            if self.signals:
                self._job.abort(f"ended by {signal.Signals(self.signals[0]).name}")
            self.step(time.monotonic_ns())
        self._report_mission(time.monotonic_ns())
        self._write_or_emit(time.monotonic_ns())

    def step(self, now_ns: int) -> None:
        """Take one step: request logs, receive, step the job, send, emit events, report."""
        if now_ns >= self._request_ns:
            self._request_ns = now_ns + REQUEST_PERIOD_NS
            standpoint = self._job.standpoint(now_ns)
            if standpoint is not None or not self._job.drives:
                self._send(self._detector.send, encode_request(self._joints, standpoint))
        self._execute_commands(now_ns)
        (report, vehicle), logs = self._newest_reports(), self._newest_logs()
        self._machine.on_reports(report, vehicle, now_ns)
        for data in self._job.step(now_ns, report, vehicle, logs):
            self._send(lambda d: self._link.sendto(d, self._controller), data)
        self._emit_changes(report)
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + REPORT_PERIOD_NS
            self._report_mission(now_ns)
        if self._checkpoint_file is not None and self._checkpoint_file.due(now_ns):
            self._write_or_emit(now_ns)

    def write_checkpoint(self, now_ns: int) -> None:
        """Write the checkpoint.

        Raises:
            OSError: it cannot be written.
        """
        checkpoint = self._job.progress()
        if self._checkpoint_file is not None and checkpoint is not None:
            self._checkpoint_file.write(checkpoint, now_ns, time.time_ns())

    def _write_or_emit(self, now_ns: int) -> None:
        """Write the checkpoint; a full disk does not stop a machine that works."""
        try:
            self.write_checkpoint(now_ns)
        except OSError as error:
            reason = f"the checkpoint cannot be written: {error.strerror}"
            if self._changed("progress", reason):
                emit("progress", reason=reason)

    def _execute_commands(self, now_ns: int) -> None:
        for data, sender in _received_from(self._commands):
            try:
                command = self._receiver.accept(data, now_ns)
            except CommandRefused as error:
                emit("order", order=None, refused=str(error))
                continue
            self._report_ns = 0  # the operator sees the result at once
            self._askers.append(sender)
            if isinstance(command, MissionUpload):
                self._take(command, now_ns)
                continue
            self._answer = {}
            refused = self._job.execute(command)
            emit("order", order=command.action.name, refused=refused or None)

    def _take(self, upload: MissionUpload, now_ns: int) -> None:
        """Take an uploaded mission, or refuse it and change nothing."""
        code = refused = ""
        try:
            if self._uploads is None:
                raise CommandRefused("upload.not-awaited", "this planner was started with its job, not with --missions")
            if self._job.begun:
                raise CommandRefused("upload.begun", "a mission has begun; abort it and start the planner anew")
            self._machine.check(now_ns)
            self._job = self._uploads.job(upload)
            self._job.step(now_ns, self._machine.report, None, None)  # it knows the mode switch before the next command
        except (CommandRefused, MissionError) as error:
            code, refused = error.code, short_text(str(error).partition("\n")[0])
        self._answer = {"order": upload.sequence, "refusal": refused, "refusal_code": code}
        emit("upload", name=upload.name, refused=refused or None, code=code or None)

    def _report_mission(self, now_ns: int) -> None:
        recipients = [(self._link, watcher) for watcher in self._watchers]
        recipients += [(self._commands, asker) for asker in self._askers]
        self._askers = []
        if not recipients:
            return
        self._sequence += 1
        sent = []
        if (grasp := self._job.chosen_grasp()) is not None:
            sent.append(encode_grasp(grasp, self._sequence, self._hash, now_ns, self._key))
        if (report := self._job.report(now_ns)) is not None:
            report = msgspec.structs.replace(report, **self._answer)
            sent.append(encode_mission(report, self._sequence, self._hash, now_ns, self._key))
        for link, to in recipients:
            for data in sent:
                self._send(lambda d, link=link, to=to: link.sendto(d, to), data)  # type: ignore[misc]

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
                newest, self._joints = message, message.position
        return newest, vehicle

    def _newest_logs(self) -> tuple[LogObservation, ...] | None:
        logs: tuple[LogObservation, ...] | None = None
        for data in _received(self._detector):
            try:
                logs = decode_logs(data, in_plane=self._job.drives)
            except InputRefused as error:
                if self._changed("detector", str(error)):
                    emit("detector", reason=str(error))
        return logs

    @staticmethod
    def _send(send: Callable[[bytes], int], data: bytes) -> None:
        # The receiver is not listening yet, or the buffer is full: the next datagram follows in 50 ms.
        with suppress(ConnectionRefusedError, BlockingIOError):
            send(data)

    def _emit_changes(self, report: StateReport | None) -> None:
        """Emit the events that have changed since the last step."""
        for event, fields in self._job.events():
            if self._changed(event, fields):
                emit("running" if fields == NOT_PAUSED else event, **fields)
        if report is not None and report.refused:
            # A flood of strangers is told once: every process can be one.
            strangers = report.refusal == Reason.DATAGRAM_AUTHENTICATION
            if self._changed("refused", None if strangers else report.refused):
                emit("refused", number=report.refusal, count=report.refused)

    def _changed(self, name: str, value: object) -> bool:
        before = self._emitted.get(name)
        self._emitted[name] = value
        return value != before


def _received(link: socket.socket) -> list[bytes]:
    return [data for data, _ in _received_from(link)]


def _received_from(link: socket.socket) -> list[tuple[bytes, Address]]:
    datagrams = []
    while True:
        try:
            datagrams.append(link.recvfrom(65535))
        except BlockingIOError:
            return datagrams
        except ConnectionRefusedError:
            continue
