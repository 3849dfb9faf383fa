"""Starting, watching and ending the processes of a live run.

Every child is its own session, so Ctrl-C reaches only the harness, which then ends the children in a chosen order;
``PR_SET_PDEATHSIG`` ends them too when the harness itself is killed.  What a child prints on stdout, one
JSON object a line or the word "ready", is read without blocking; its stderr goes to ``<name>.err`` in the run's
directory and is quoted when it fails.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from host.exits import Exit, Stopped

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None)


def _die_with_parent() -> None:
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@dataclass(slots=True)
class Child:
    """One running process and the unfinished line of its stdout."""

    name: str
    process: subprocess.Popen[bytes]
    errors: Path
    rest: bytes = b""

    def complaint(self) -> str:
        """The last line it wrote to stderr, or how it ended."""
        lines = self.errors.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self.process.returncode}"


@dataclass(slots=True)
class Family:
    """The children of one run, in the order in which they were started."""

    directory: Path
    children: dict[str, Child] = field(default_factory=dict)
    selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)
    environment: dict[str, str] = field(default_factory=dict)
    """What the children get beside the harness's own variables."""
    own_sessions: bool = True
    """Each child in a session of its own; else in the harness's, where the scheduler has them share one weight."""

    def start(self, name: str, module: str, *arguments: object) -> Child:
        """Start ``python -m module arguments...`` under ``name``."""
        return self.launch(name, sys.executable, "-m", module, *arguments)

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
        """What the children have said since the last call, as (name, JSON object); never blocks."""
        said = []
        for key, _ in self.selector.select(0):
            child: Child = key.data
            data = child.process.stdout.read() if child.process.stdout else b""
            if data == b"":
                self.selector.unregister(key.fileobj)
                continue
            *lines, child.rest = (child.rest + (data or b"")).split(b"\n")
            for line in lines:
                if line == b"ready":
                    said.append((child.name, {"ready": True}))
                with contextlib.suppress(json.JSONDecodeError):
                    message = json.loads(line)
                    if isinstance(message, dict):
                        said.append((child.name, message))
        return said

    def dead(self) -> Child | None:
        """A child that has ended, if any."""
        return next((c for c in self.children.values() if c.process.poll() is not None), None)

    def await_message(self, name: str, key: str, seconds: float) -> dict[str, Any]:
        """Wait until child ``name`` says a JSON object that holds ``key``.

        Raises:
            Stopped: when a child ends first or the time is over.
        """
        limit = time.monotonic() + seconds
        while time.monotonic() < limit:
            gone = self.dead()
            for who, message in self.messages():
                if who == name and key in message:
                    return message
            if gone:
                code = gone.process.returncode
                raise Stopped(Exit(code) if code in set(Exit) and code else Exit.CONFIGURATION, gone.complaint())
            self.selector.select(0.05)
        raise Stopped(Exit.CONFIGURATION, f"{name} did not start within {seconds:.0f} s; see {name}.err")

    def hasten(self, name: str, priority: int) -> bool:
        """Give every thread that a child has real-time priority (SCHED_FIFO); False if refused."""
        try:
            for thread in os.listdir(f"/proc/{self.children[name].process.pid}/task"):
                os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
        except OSError:
            return False
        return True

    def weigh(self, name: str, niceness: int) -> None:
        """Set a child's share among the processes without a deadline; only root may raise it."""
        pid = self.children[name].process.pid
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, pid, niceness)
            # Each child is a session, and sessions compete as groups whatever their niceness (sched(7), autogroup).
            Path(f"/proc/{pid}/autogroup").write_text(str(niceness))

    def stop(self, name: str, seconds: float = 5.0) -> int | None:
        """End a child with SIGTERM, after ``seconds`` with SIGKILL; its exit code, or None when it never ran."""
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


def free_udp_ports(count: int) -> list[int]:
    """``count`` different UDP ports on loopback that are free now."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for s in sockets:
            s.bind(("127.0.0.1", 0))
        return [s.getsockname()[1] for s in sockets]
    finally:
        for s in sockets:
            s.close()
