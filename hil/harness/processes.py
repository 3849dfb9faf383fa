"""Starts, watches and ends the processes of a live run.

Every child has its own session, so Ctrl-C reaches only the harness, which then ends the children in a chosen order;
``PR_SET_PDEATHSIG`` ends them when the harness itself is killed.  A child prints JSON objects or the word "ready" on
stdout, one per line, read without blocking; its stderr goes to ``<name>.err`` in the run's directory and is quoted when
the child fails.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from host.exit_codes import CommandFailed, ExitCode

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None)


def _die_with_parent() -> None:
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@dataclass(slots=True)
class Child:
    """One running process; ``rest`` is the unfinished line of its stdout."""

    name: str
    process: subprocess.Popen[bytes]
    errors: Path
    rest: bytes = b""

    def complaint(self) -> str:
        """Return the last line of its stderr, or its exit code."""
        lines = self.errors.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self.process.returncode}"


@dataclass(slots=True)
class ProcessGroup:
    """The child processes of one run, in starting order."""

    directory: Path
    children: dict[str, Child] = field(default_factory=dict)
    selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    environment: dict[str, str] = field(default_factory=dict)
    """Environment variables of the children in addition to the harness's own."""
    own_sessions: bool = True
    """Each child gets its own session; else all share that of the harness, with one scheduling weight."""

    def start(self, name: str, module: str, *arguments: object, **options: object) -> Child:
        """Start ``python -m module arguments... options...`` under ``name`` (`words_of`)."""
        return self.launch(name, sys.executable, "-m", module, *arguments, *words_of(options))

    def launch(self, name: str, *command: object) -> Child:
        """Start a program under ``name``."""
        errors = self.directory / f"{name}.err"
        with errors.open("wb") as stderr:
            process = subprocess.Popen(
                [*map(str, command)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=stderr,
                start_new_session=self.own_sessions,
                preexec_fn=_die_with_parent,
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **self.environment},
            )
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        child = Child(name, process, errors)
        self.children[name] = child
        self.selector.register(process.stdout, selectors.EVENT_READ, child)
        return child

    def messages(self) -> list[tuple[str, dict[str, Any]]]:
        """Return the messages of the children since the last call, as (name, JSON object); never block."""
        received = []
        for key, _ in self.selector.select(0):
            child: Child = key.data
            data = child.process.stdout.read() if child.process.stdout else b""
            if data == b"":
                self.selector.unregister(key.fileobj)
                continue
            *lines, child.rest = (child.rest + (data or b"")).split(b"\n")
            for line in lines:
                if line == b"ready":
                    received.append((child.name, {"ready": True}))
                with contextlib.suppress(json.JSONDecodeError):
                    message = json.loads(line)
                    if isinstance(message, dict):
                        received.append((child.name, message))
        return received

    def dead(self) -> Child | None:
        """Return a child that has ended, if any."""
        return next((c for c in self.children.values() if c.process.poll() is not None), None)

    def await_message(self, name: str, key: str, seconds: float) -> dict[str, Any]:
        """Wait until child ``name`` prints a JSON object that holds ``key``.

        Raises:
            CommandFailed: a child ends first, or the time is up.
        """
        limit = time.monotonic() + seconds
        while time.monotonic() < limit:
            gone = self.dead()
            for who, message in self.messages():
                if who == name and key in message:
                    return message
            if gone:
                code = gone.process.returncode
                raise CommandFailed(
                    "live.start-failed",
                    gone.complaint(),
                    ExitCode(code) if code in set(ExitCode) and code else ExitCode.CONFIGURATION,
                )
            self.selector.select(0.05)
        raise CommandFailed(
            "live.start-timeout", f"{name} did not start within {seconds:.0f} s; see {name}.err", ExitCode.CONFIGURATION
        )

    def set_fifo_priority(self, name: str, priority: int) -> bool:
        """Give every thread of a child a real-time priority (SCHED_FIFO); False if refused."""
        try:
            for thread in os.listdir(f"/proc/{self.children[name].process.pid}/task"):
                os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            return False
        return True

    def set_niceness(self, name: str, niceness: int) -> None:
        """Set the niceness of a child without deadlines; only root may lower the number."""
        pid = self.children[name].process.pid
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, pid, niceness)
            # Sessions compete as groups, whatever the niceness of their processes (sched(7), autogroup).
            Path(f"/proc/{pid}/autogroup").write_text(str(niceness))

    def stop(self, name: str, seconds: float = 5.0) -> int | None:
        """End a child with SIGTERM, after ``seconds`` with SIGKILL; return its exit code, None when it never ran."""
        child = self.children.get(name)
        if child is None:
            return None
        if child.process.poll() is None:
            child.process.terminate()
            try:
                child.process.wait(seconds)
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()
        if child.process.stdout:
            with contextlib.suppress(KeyError):
                self.selector.unregister(child.process.stdout)
            child.process.stdout.close()
        del self.children[name]
        return child.process.returncode

    def stop_all(self, order: tuple[str, ...]) -> None:
        """End every child: first those in ``order``, then the rest, youngest first."""
        for name in (*order, *reversed(tuple(self.children))):
            self.stop(name)
        self.selector.close()


def words_of(options: Mapping[str, object]) -> list[object]:
    """Make command-line options: ``report_port=5`` is ``--report-port 5``; a list repeats its option, None omits it."""
    arguments: list[object] = []
    for name, value in options.items():
        for option_value in value if isinstance(value, list) else [] if value is None else [value]:
            arguments += [f"--{name.replace('_', '-')}", option_value]
    return arguments


def announce_ready() -> list[int]:
    """Tell the harness, from a child, that it is ready; SIGTERM and SIGINT go into the returned list."""
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda which, _frame: ended.append(which))
    gc.collect()
    gc.freeze()
    print("ready", flush=True)
    return ended


def free_udp_ports(count: int) -> list[int]:
    """Find ``count`` different UDP ports that are free on loopback now."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for s in sockets:
            s.bind(("127.0.0.1", 0))
        return [s.getsockname()[1] for s in sockets]
    finally:
        for s in sockets:
            s.close()
