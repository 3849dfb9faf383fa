"""``timberhand operator``: heartbeats are answers of the terminal, Ctrl-C ends the watch, a lost terminal does not."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from can_dbc.messages.crane import OperatorAction, OperatorCommand
from can_dbc.messages.datagrams import decode
from machine.loading.profile_file import load_profile, profile_hash
from tests.operator_end import OperatorEnd
from timberhand.terminal_watch import QUESTION

THERE = b"\x1b[0n"


# -- the pure part


# -- the command


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[socket.socket]:
    with OperatorEnd(tmp_path / "operator") as made:
        made.settimeout(20)
        yield made


def heard(controller: socket.socket) -> OperatorCommand:
    command = decode(controller.recv(100))
    assert isinstance(command, OperatorCommand)
    return command


def start(word: str, path: str, terminal: int | None = None, *more: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "timberhand", "operator", word, "--operator", path, *more],
        stdin=terminal,
        stdout=terminal,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # nohup hands an ignored one down
    )


class Terminal:
    """A person's terminal on a pseudo-terminal, which answers while it is linked."""

    def __init__(self) -> None:
        self.mine, self.theirs = pty.openpty()

    def answer(self, seconds: float) -> bytes:
        """Answer for so long; what was shown."""
        shown, until_s = b"", time.monotonic() + seconds
        while time.monotonic() < until_s:
            if select.select([self.mine], [], [], 0.02)[0]:
                read = os.read(self.mine, 4096)
                os.write(self.mine, THERE * read.count(QUESTION))
                shown += read
        return shown

    def close(self) -> None:
        os.close(self.mine)
        os.close(self.theirs)


def test_a_terminal_watches_until_it_is_interrupted(controller: socket.socket) -> None:
    terminal = Terminal()
    process = start("watch", controller.getsockname(), terminal.theirs)
    while not select.select([controller], [], [], 0)[0]:
        terminal.answer(0.1)
        assert process.poll() is None, process.stderr and process.stderr.read()
    terminal.answer(1.0)
    process.send_signal(signal.SIGINT)
    terminal.answer(0.5)
    assert process.wait(20) == 0
    commands = [heard(controller)]
    while commands[-1].action is OperatorAction.WATCH:
        commands.append(heard(controller))
    assert len(commands) >= 3 and commands[-1].action is OperatorAction.WATCH_END
    assert commands[0].profile_hash == profile_hash(load_profile("palms_471"))
    terminal.close()


def test_a_cut_terminal_makes_no_heartbeat_and_ends_no_watch(controller: socket.socket) -> None:
    terminal = Terminal()
    process = start("watch", controller.getsockname(), terminal.theirs)
    while not select.select([controller], [], [], 0)[0]:
        terminal.answer(0.1)
    controller.settimeout(0.5)
    with pytest.raises(TimeoutError):
        while True:
            assert heard(controller).action is OperatorAction.WATCH
    assert process.poll() is None, "the program runs on"
    process.send_signal(signal.SIGHUP)  # as sshd, when it has found out
    process.wait(20)
    with pytest.raises(TimeoutError):
        heard(controller)
    terminal.close()


def test_unwatch_ends_the_watch(controller: socket.socket) -> None:
    assert start("unwatch", controller.getsockname()).wait(30) == 0
    assert heard(controller).action is OperatorAction.WATCH_END


@pytest.mark.parametrize("left", ["operator", "operator.key"])
def test_what_is_missing_is_said(tmp_path: Path, controller: socket.socket, left: str) -> None:
    """Without the controller, or without its credential."""
    for name in {"operator", "operator.key"} - {left}:
        (tmp_path / name).unlink()
    process = start("unwatch", controller.getsockname())
    _, said = process.communicate(timeout=30)
    assert process.returncode == 4 and b"operator.no-controller" in said and said.count(b"\n") == 1


def test_a_profile_that_watches_no_link_is_said(tmp_path: Path) -> None:
    text = Path("machine/palms_471.toml").read_text().replace("operator_link_ms = 1000", "operator_link_ms = 0")
    (tmp_path / "own.toml").write_text(text)
    process = start("watch", str(tmp_path / "nobody"), None, "--profile", str(tmp_path / "own.toml"))
    _, said = process.communicate(timeout=30)
    assert process.returncode == 3 and b"operator.not-watched" in said
