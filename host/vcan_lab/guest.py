"""The inner part of the lab: creates the interfaces, runs the command, reports its end.  Standard library alone.

It is the first process of the user-mode kernel, where three consoles connect it with the host, or an ordinary process
(methods ``existing`` and ``namespace``) with three descriptors: control, out, err.

Control channel, JSON lines.  In: the order (``spec.order``), then ``{"signal": N}`` and ``{"close": "out"}``.
Out: ``{"ready"}``, then ``{"started"}``, ``{"exit": N}`` (-N for signal N), or ``{"error"}`` when the lab fails.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import select
import signal
import subprocess
import sys
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from host.vcan_lab import links

MODULES = (
    "net/can/can",
    "net/can/can-raw",
    "net/can/can-bcm",
    "net/can/can-gw",
    "net/can/j1939/can-j1939",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
)
SETTINGS = {
    "kernel/sched_rt_runtime_us": "-1",  # a FIFO loop is never throttled
    "vm/dirty_writeback_centisecs": "50",  # the host sees written data after a second, not after thirty
    "vm/dirty_expire_centisecs": "50",
}
SOFT_INTERRUPT_PRIORITY = 95
STRAGGLER_S = 0.5
"""Silence after the end of the command after which its remaining output is cut off."""

_SYS_FINIT_MODULE = 313
_POWER_OFF = 0x4321_FEDC
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_MS_REMOUNT, _MS_NOATIME = 32, 1024
_libc = ctypes.CDLL(None, use_errno=True)


def main(descriptors: list[str]) -> None:
    """Run the guest; called by ``spec.RUN_GUEST``."""
    if os.getpid() == 1:
        _first_process()
    control, out, err = map(int, descriptors)
    host = Host(control)
    order = host.receive_order()
    try:
        if order["links"]:
            links.enter_namespace(order["links"], order["as_root"])
    except OSError as reason:
        host.send(error=_sentence(reason))
        return
    Supervisor(host, order, {"out": out, "err": err}, user=None).run()


def _first_process() -> NoReturn:
    # No access times, and the kernel has mounted it read-only: a file read for the first time since it was written
    # would be written back seconds later, and in simulated time the first run would differ from the next by that.
    _mount("none", "/", "none", flags=_MS_REMOUNT | _MS_NOATIME)
    _mount("proc", "/proc", "proc")
    _mount("devtmpfs", "/dev", "devtmpfs")  # the kernel may have mounted it
    out, err, control = (os.open(f"/dev/tty{n}", os.O_RDWR | os.O_NOCTTY) for n in (1, 2, 3))
    for console in (control, out, err):
        tty.setraw(console)
    host = Host(control)
    with _held_time():
        order = host.receive_order()
    try:
        _set_up(order)
        links.create(order["links"])
    except OSError as reason:
        host.send(error=_sentence(reason))
    else:
        Supervisor(host, order, {"out": out, "err": err}, order["user"]).run()
    termios.tcdrain(control)
    os.sync()
    _libc.reboot(_POWER_OFF)
    sys.exit("the kernel did not halt")


@contextlib.contextmanager
def _held_time() -> Iterator[None]:
    """Hold simulated time, if the kernel has it, while waiting for the host.

    Simulated time advances when nothing can run, by thousands of seconds per second; so an idle-priority process runs
    meanwhile.  Everything after starts at the same time in every run.
    """
    if "time-travel=" not in Path("/proc/cmdline").read_text():
        yield
        return
    spinner = os.fork()
    if spinner == 0:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        while True:
            os.sched_yield()
    yield
    os.kill(spinner, signal.SIGKILL)
    os.waitpid(spinner, 0)


def _set_up(order: dict[str, Any]) -> None:
    """Set up mounts, modules and settings of a booted machine."""
    os.umask(0)
    _mount("sysfs", "/sys", "sysfs")
    os.makedirs("/dev/pts", exist_ok=True)
    os.makedirs(memory := "/dev/shm", exist_ok=True)  # mounted here, in a machine of its own  # nosec B108
    _mount("devpts", "/dev/pts", "devpts", "ptmxmode=0666")
    if order["host_shm"]:
        _mount("none", memory, "hostfs", memory)
    else:
        _mount("tmpfs", memory, "tmpfs", "mode=1777")
    runtime = order["env"]["XDG_RUNTIME_DIR"]
    os.mkdir(runtime, 0o700)
    if order["user"]:
        os.chown(runtime, *order["user"][:2])
    for name, target in (("fd", "fd"), ("stdin", "fd/0"), ("stdout", "fd/1"), ("stderr", "fd/2")):
        if not os.path.lexists(f"/dev/{name}"):
            os.symlink(f"/proc/self/{target}", f"/dev/{name}")
    folder = Path(f"/usr/lib/uml/modules/{os.uname().release}/kernel")
    if folder.is_dir():  # the lab's own kernel has them built in
        for name in MODULES:
            _load_module(folder / f"{name}.ko")
    for setting, value in SETTINGS.items():
        Path("/proc/sys", setting).write_text(value)
    for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
        resource.setrlimit(limit, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    prioritize_soft_interrupts(Path("/proc"))


def prioritize_soft_interrupts(proc: Path) -> None:
    """Give ksoftirqd, which delivers deferred frames and datagrams, a real-time priority.

    Every frame passes a soft interrupt; once one is deferred to ksoftirqd, all wait for it.  At its ordinary priority,
    busy processes delayed frames by more than 15 ms while FIFO tasks ran on time (measured).
    """
    for comm in proc.glob("[0-9]*/comm"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a kernel worker that has just ended
            if comm.read_text().startswith("ksoftirqd"):
                os.sched_setscheduler(int(comm.parent.name), os.SCHED_FIFO, os.sched_param(SOFT_INTERRUPT_PRIORITY))


def _end_descendants() -> None:
    """Kill all processes that the command left; this process is their subreaper, so all are its descendants."""
    while children := _children(os.getpid()):
        for pid in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(-1, 0)


def _children(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def _sentence(reason: OSError) -> str:
    return f"{reason.filename}: {reason.strerror}" if reason.filename else str(reason.strerror)


def _mount(source: str, target: str, kind: str, options: str = "", flags: int = 0) -> None:
    _libc.mount(source.encode(), target.encode(), kind.encode(), flags, options.encode())


def _load_module(path: Path) -> None:
    with path.open("rb") as module:
        if _libc.syscall(_SYS_FINIT_MODULE, module.fileno(), b"", 0):
            number = ctypes.get_errno()
            raise OSError(number, f"kernel module {path}: {os.strerror(number)}")


class Host:
    """The control channel to the host."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._rest = b""

    def send(self, **message: Any) -> None:
        os.write(self.fd, json.dumps(message).encode() + b"\n")

    def receive_order(self) -> dict[str, Any]:
        self.send(ready=True)
        while (messages := self.receive()) is not None:
            for message in messages:
                if "argv" in message:
                    return message
        sys.exit(1)  # the wrapper is gone

    def receive(self) -> list[dict[str, Any]] | None:
        """Read the messages of a readable channel; None at its end."""
        data = os.read(self.fd, 65536)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines] if data else None


class Supervisor:
    """Starts the command; forwards its output to the host and signals to it, until it ends."""

    def __init__(self, host: Host, order: dict[str, Any], sinks: dict[str, int], user: list[Any] | None) -> None:
        self.host = host
        self.order = order
        self.sinks = sinks
        self.user = user
        self.sources: dict[int, str] = {}
        self.pid = 0
        self.command: subprocess.Popen[bytes] | None = None
        self.status: int | None = None

    def run(self) -> None:
        woken, wake = os.pipe()
        os.set_blocking(wake, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1)
        self.host.send(started=True)
        if not self._start():
            return
        silent_until = None
        while self.status is None or self.sources:
            wait_s = None if silent_until is None else max(0.0, silent_until - time.monotonic())
            ready = select.select([self.host.fd, woken, *self.sources], [], [], wait_s)[0]
            if not ready:
                break
            for fd in ready:
                if fd == woken:
                    os.read(woken, 512)
                    self._reap()
                elif fd == self.host.fd:
                    self._on_control()
                elif fd in self.sources:
                    self._forward(fd)
            if self.status is not None:
                silent_until = time.monotonic() + STRAGGLER_S
        if os.getpid() == 1:
            for sink in self.sinks.values():
                termios.tcdrain(sink)
        else:
            _end_descendants()
        assert self.status is not None  # only then can the wait end without input
        self.host.send(exit=os.waitstatus_to_exitcode(self.status))

    def _start(self) -> bool:
        """Start the command; if that fails, report it like a shell (126, 127)."""
        order = self.order
        uid, gid, groups = self.user or (None, None, None)
        pipes = {name: os.pipe() for name in self.sinks}
        try:
            # Keep the object: its destructor would collect the exit status of the command.
            self.command = subprocess.Popen(
                order["argv"],
                stdin=subprocess.DEVNULL,
                stdout=pipes["out"][1],
                stderr=pipes["err"][1],
                cwd=order["cwd"],
                env=order["env"],
                umask=order["umask"],
                user=uid,
                group=gid,
                extra_groups=groups,
                start_new_session=True,
                preexec_fn=lambda: _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL),
            )
            self.pid = self.command.pid
        except OSError as reason:
            os.write(self.sinks["err"], f"vcan lab: {reason.filename}: {reason.strerror}\n".encode())
            self.host.send(exit=127 if isinstance(reason, FileNotFoundError) else 126)
            return False
        for name, (source, sink) in pipes.items():
            os.close(sink)
            self.sources[source] = name
        return True

    def _reap(self) -> None:
        """Collect every child that has ended, including orphans of the command."""
        while self.status is None or os.getpid() == 1:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid == self.pid:
                self.status = status

    def _on_control(self) -> None:
        messages = self.host.receive()
        if messages is None:  # the wrapper is gone
            _end_descendants()
            sys.exit(1)
        for message in messages:
            if "signal" in message:
                self._signal(message["signal"])
            elif "close" in message:
                for fd in [fd for fd, name in self.sources.items() if name == message["close"]]:
                    self._end(fd)

    def _forward(self, fd: int) -> None:
        data = os.read(fd, 65536)
        if not data:
            self._end(fd)
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(self.sinks[self.sources[fd]], rest) :]

    def _end(self, fd: int) -> None:
        del self.sources[fd]
        os.close(fd)

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)
