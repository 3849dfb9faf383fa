"""Runs a command in the lab: starts the guest, forwards streams and signals, enforces the time limits.

``run`` returns the exit status of the command, 128+N for signal N, 124 (as timeout(1)) after its time limit.
Failure: ``LabError`` when the guest does not start or dies.  A guest that dies before the command was started is booted
once more, with a message.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from host.vcan_lab import uml
from host.vcan_lab.choose import Method
from host.vcan_lab.spec import PACKAGE_ROOT, RUN_GUEST, LabError, Request, order

FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2)
TIMED_OUT = 124
BOOTS = 2
"""A user-mode kernel rarely (less than once in 400 boots) dies before its first process starts."""
GRACE_S = 5.0
"""Time from SIGTERM to SIGKILL after the time limit, from there to the end of the guest, and from exit to halt."""

_PR_SET_PDEATHSIG = 1
_CHUNK = select.PIPE_BUF
"""A pipe that polls as writable accepts this much without blocking."""
_LOG_LINES = 12
_NOISE = re.compile("umid|SELinux|mmapper_init|ubd device|^reboot:")
"""Harmless messages of the kernel."""


def run(request: Request, method: Method, verbose: bool = False) -> int:
    """Run the command until it and the guest have ended.  Main thread only, because it handles signals.

    When the caller dies, the command is told by SIGHUP, as by a terminal that is closed; under nohup it goes on.
    """
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGHUP)
    for boots_left in reversed(range(BOOTS)):
        lab = Lab(request, method)
        try:
            lab.serve()
            status = lab.status()
            break
        except LabError as reason:
            if not boots_left or not lab.gone_while_booting:
                raise
            print(f"vcan lab: {reason}\nvcan lab: the command was not started yet; booting once more", file=sys.stderr)
        finally:
            lab.end()
    if verbose:
        print(lab.summary(), file=sys.stderr)
    return status


@dataclass(slots=True)
class Stream:
    """One output of the command and the caller's descriptor ``sink`` for it (None: closed)."""

    source: int
    sink: int | None
    pending: memoryview | None = None


class Lab:
    """A running guest.  Stages: boot, run, term and kill (time limit), halt (the command has ended), over."""

    def __init__(self, request: Request, method: Method) -> None:
        self.request = request
        self.method = method
        self.report: dict[str, Any] = {}
        self.stage = "boot"
        self.began_s = time.monotonic()
        self.booted_s = self.began_s
        self.deadline_s: float | None = self.began_s + request.boot_timeout_s
        self.timed_out = False
        self.interrupted = 0
        self._half_line = b""
        self._log = os.memfd_create("kernel log")
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        self._handlers = {number: signal.signal(number, lambda *_: None) for number in FORWARDED}
        self._handlers[signal.SIGPIPE] = signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # `_write` handles it
        self.control, guest_end = socket.socketpair()
        (out, out_far), (err, err_far) = os.pipe(), os.pipe()
        self.streams = {"out": Stream(out, sys.stdout.fileno()), "err": Stream(err, sys.stderr.fileno())}
        passed = (out_far, err_far, guest_end.fileno())
        try:
            if method.kernel:
                self.guest = uml.start(method.kernel, request, passed, self._log)
            else:
                self.guest = self._start_native(passed)
        finally:
            guest_end.close()
            os.close(out_far)
            os.close(err_far)

    def _start_native(self, passed: tuple[int, int, int]) -> subprocess.Popen[bytes]:
        out, err, control = passed
        return subprocess.Popen(
            [sys.executable, "-ISB", "-c", RUN_GUEST, PACKAGE_ROOT, str(control), str(out), str(err)],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            start_new_session=True,
            pass_fds=passed,
        )

    def serve(self) -> None:
        """Forward everything until the guest has closed its channels and all output is written."""
        connected = True
        while connected or self.streams:
            wait = select.poll()
            wait.register(self._woken, select.POLLIN)
            if connected:
                wait.register(self.control, select.POLLIN)
            for stream in self.streams.values():
                if stream.pending and stream.sink is not None:
                    wait.register(stream.sink, select.POLLOUT)
                else:
                    wait.register(stream.source, select.POLLIN)
            ready = {fd for fd, _ in wait.poll(self._timeout_ms())}
            if self.deadline_s is not None and time.monotonic() >= self.deadline_s:
                if self.stage == "over":
                    return
                self._on_deadline()
            if self._woken in ready:
                for number in os.read(self._woken, 64):
                    self._on_signal(number)
            if self.control.fileno() in ready:
                connected = self._receive()
            for name, stream in list(self.streams.items()):
                if stream.pending and stream.sink in ready:
                    self._write(name, stream)
                elif stream.source in ready:
                    self._read(name, stream)

    def status(self) -> int:
        """Return the exit status of the command; raises LabError when there is none."""
        if self.timed_out:
            return TIMED_OUT
        if self.interrupted:
            return 128 + self.interrupted
        if "exit" not in self.report:
            raise LabError("lab.guest-died", self._failure_report())
        status: int = self.report["exit"]
        if status == -signal.SIGKILL and "Out of memory" in self._kernel_log():
            print(
                f"vcan lab: the guest's {self.request.mem_mb} MB of memory did not suffice; use --mem", file=sys.stderr
            )
        return status if status >= 0 else 128 - status

    @property
    def gone_while_booting(self) -> bool:
        """Whether the guest died without a reason before the command was started."""
        return not self.report.keys() & {"started", "error"}

    def end(self) -> None:
        """Kill the guest, wait for it, release descriptors and signal handlers."""
        self._kill()
        self.guest.wait()
        signal.set_wakeup_fd(-1)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self.control.close()
        for fd in (self._log, self._woken, self._wake, *(stream.source for stream in self.streams.values())):
            os.close(fd)

    def summary(self) -> str:
        """Summarize times and memory of an ended lab."""
        text = f"vcan lab: {self.method.kind}, ready after {self.booted_s - self.began_s:.2f} s"
        text += f", ended after {time.monotonic() - self.began_s:.2f} s"
        if self.method.kernel:
            peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss >> 10
            text += f"; guest memory {self.request.mem_mb} MB, peak on the host {peak_mb} MB"
        return text

    def _timeout_ms(self) -> float | None:
        return None if self.deadline_s is None else max(0.0, self.deadline_s - time.monotonic()) * 1e3 + 1.0

    def _enter(self, stage: str, seconds: float | None) -> None:
        self.stage = stage
        self.deadline_s = None if seconds is None else time.monotonic() + seconds

    def _on_deadline(self) -> None:
        if self.stage == "run":
            self.timed_out = True
            self._send(signal=signal.SIGTERM)
            self._enter("term", GRACE_S)
        elif self.stage == "term":
            self._send(signal=signal.SIGKILL)
            self._enter("kill", GRACE_S)
        else:
            if self.stage == "boot":
                self.report["error"] = f"no answer within {self.request.boot_timeout_s:g} s (--boot-timeout)"
            self._kill()

    def _kill(self) -> None:
        if self.guest.stdin:
            self.guest.stdin.close()  # the keeper ends with it
        else:
            self.guest.kill()
        self._enter("over", 1.0)

    def _on_signal(self, number: int) -> None:
        if self.stage == "boot":
            self.interrupted = number
            self._kill()
        else:
            self._send(signal=number)

    def _send(self, **message: Any) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):
            self.control.sendall(json.dumps(message).encode() + b"\n")

    def _receive(self) -> bool:
        """Handle the messages of the guest; False after the last one."""
        try:
            data = self.control.recv(65536)
        except ConnectionResetError:
            data = b""
        *lines, self._half_line = (self._half_line + data).split(b"\n")
        for message in map(json.loads, lines):
            self.report |= message
            if "ready" in message:
                needed = [sys.prefix, sys.base_prefix, PACKAGE_ROOT]
                lab = "uml" if self.method.kernel else "native"
                self._send(**order(self.request, lab, self.method.kind != "existing", needed))
            elif "started" in message:
                self.booted_s = time.monotonic()
                self._enter("run", self.request.timeout_s)
            elif "exit" in message:
                self._enter("halt", GRACE_S)
        return bool(data)

    def _read(self, name: str, stream: Stream) -> None:
        data = os.read(stream.source, 65536)
        if not data:
            os.close(self.streams.pop(name).source)
        elif stream.sink is not None:
            stream.pending = memoryview(data)

    def _write(self, name: str, stream: Stream) -> None:
        assert stream.pending and stream.sink is not None
        try:
            stream.pending = stream.pending[os.write(stream.sink, stream.pending[:_CHUNK]) :]
        except BrokenPipeError:  # as with a direct pipe: the next write of the command fails
            stream.sink = stream.pending = None
            self._send(close=name)

    def _kernel_log(self) -> str:
        return os.pread(self._log, 1 << 20, 0).decode(errors="replace")

    def _failure_report(self) -> str:
        reason = self.report.get("error") or (
            "the guest ended during its boot" if self.stage == "boot" else "the guest died"
        )
        lines = [line for line in self._kernel_log().splitlines() if line and not _NOISE.search(line)][-_LOG_LINES:]
        return "\n  ".join([f"the lab failed ({self.method.kind}): {reason}", *lines])
