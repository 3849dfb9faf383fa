"""``timberhand operator``: heartbeats are answers of the terminal, Ctrl-C ends the watch, a lost terminal does not."""

from __future__ import annotations

import io
import os
import signal
from pathlib import Path

import pytest
from typer.testing import CliRunner

from can_dbc.messages.datagrams import decode
from console.accounts import read_accounts
from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import InputRefused
from tests.codes import coded
from timberhand.cli import app
from timberhand.terminal_watch import FIRST_ANSWER_NS, MAX_QUESTIONS, TerminalWatch, watch

MS = 1_000_000
LIMIT_NS = 1000 * MS
THERE = b"\x1b[0n"


def test_an_answer_is_a_heartbeat_with_the_stamp_of_its_question() -> None:
    terminal = TerminalWatch(LIMIT_NS)
    assert terminal.ask(1000 * MS) and not terminal.ask(1199 * MS) and terminal.ask(1200 * MS)
    assert terminal.read(THERE, 1210 * MS) == 1000 * MS
    assert terminal.read(THERE, 1220 * MS) == 1200 * MS
    assert terminal.read(THERE, 1230 * MS) is None, "nothing was asked"


def test_keys_are_ignored_and_a_divided_answer_is_put_together() -> None:
    terminal = TerminalWatch(LIMIT_NS)
    terminal.ask(1000 * MS)
    assert terminal.read(b"q\x1b[A12n", 1001 * MS) is None
    assert terminal.read(b"x\x1b", 1002 * MS) is None and terminal.read(b"[0", 1003 * MS) is None
    assert terminal.read(b"n", 1004 * MS) == 1000 * MS


def test_answers_that_took_too_long_are_no_heartbeats() -> None:
    terminal = TerminalWatch(LIMIT_NS)
    for k in range(6):
        terminal.ask((1000 + 200 * k) * MS)
    assert terminal.read(THERE, 2000 * MS) is None
    assert terminal.read(3 * THERE, 2050 * MS) == 1600 * MS, "the newest one"


def test_a_terminal_that_falls_silent_is_not_asked_for_ever() -> None:
    terminal = TerminalWatch(LIMIT_NS)
    terminal.ask(1000 * MS)
    terminal.read(THERE, 1001 * MS)
    assert sum(terminal.ask((1200 + 200 * k) * MS) for k in range(100)) == MAX_QUESTIONS


def test_a_terminal_that_never_answers_is_refused() -> None:
    terminal = TerminalWatch(LIMIT_NS)
    terminal.ask(1000 * MS)
    assert terminal.ask(1000 * MS + FIRST_ANSWER_NS - 1)
    with pytest.raises(InputRefused, check=coded("operator.silent-terminal")):
        terminal.ask(1000 * MS + FIRST_ANSWER_NS)


def test_a_pipe_is_no_terminal() -> None:
    reading, writing = os.pipe()
    with pytest.raises(InputRefused, check=coded("operator.no-terminal")):
        watch(lambda stamp_ns: None, LIMIT_NS, reading, writing)
    os.close(reading)
    os.close(writing)


@pytest.mark.parametrize(("number", "told"), [(signal.SIGINT, ["WATCH_END"]), (signal.SIGTERM, [])])
def test_only_ctrl_c_ends_the_watch_on_purpose(
    number: signal.Signals, told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A session that the system ends gets SIGTERM; the command line takes that like Ctrl-C elsewhere."""
    sent: list[str] = []
    monkeypatch.setattr("can_dbc.messages.operator_link.send", lambda data, path: sent.append(decode(data).action.name))
    monkeypatch.setattr("timberhand.terminal_watch.watch", lambda send, limit_ns: signal.raise_signal(number))
    both = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(each, signal.default_int_handler) for each in both]  # as the command line sets them
    try:
        done = CliRunner().invoke(app, ["operator", "watch", "--operator", "/nowhere"])
        assert signal.getsignal(signal.SIGTERM) is signal.default_int_handler
    finally:
        for each, handler in zip(both, before, strict=True):
            signal.signal(each, handler)
    assert sent == told and done.exit_code == (ExitCode.OK if told else ExitCode.INTERRUPTED)


def test_a_socket_that_cannot_be_is_refused_as_one_that_nobody_serves() -> None:
    """Beside the root there is no folder for the guard's."""
    done = CliRunner().invoke(app, ["operator", "unwatch", "--operator", "/nowhere"])
    assert isinstance(done.exception, CommandFailed) and done.exception.code == "operator.no-controller"


def test_a_password_from_a_pipe_is_text_and_ends_before_its_line_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def piped(line: bytes) -> None:
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(line), "utf-8", "surrogateescape", newline="\n"))
        app(["operator", "password", "anna", "--role", "operator", "--file", str(path)], standalone_mode=False)

    path = tmp_path / "accounts"
    with pytest.raises(CommandFailed, check=coded("operator.password")) as refused:
        piped(b"hemlock \xff spruce\n")
    assert refused.value.exit_code == ExitCode.USAGE and not path.exists()
    piped(b"hemlock and spruce\r\n")
    assert read_accounts(path).check("anna", "hemlock and spruce")
