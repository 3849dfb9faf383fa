"""``timberhand operator``: watch the machine from a terminal, end the watch, and keep the accounts of its page."""

from __future__ import annotations

import os
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import ConfigError
from timberhand.commands.options import ProfileOption

if TYPE_CHECKING:
    from collections.abc import Callable

    from can_dbc.messages.crane import OperatorAction
    from machine.profile import Profile

app = typer.Typer(no_args_is_help=True, help="Watch the machine from a terminal; keep the accounts of its page.")
SERVICE_SOCKET = Path("/run/timberhand-operator/controller")
"""The installed controller's socket for operators."""


class RoleName(StrEnum):
    """Roles of the page's users (`console.accounts.Role`)."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    TECHNICIAN = "technician"


SocketOption = Annotated[
    Path | None, typer.Option("--operator", metavar="FILE", help="The controller's socket for operators.")
]


@app.command("watch")
def watch(profile: ProfileOption = "palms_471", operator: SocketOption = None) -> None:
    """Watch until Ctrl-C, which ends the watch on purpose.

    Every heartbeat is an answer of this terminal. When its link is cut, as by a lost network under ssh, or the system
    ends the session (SIGTERM), the machine holds within a second, and it cannot be armed until somebody watches again
    or the watch is ended. Inside screen or tmux the answers are theirs: run those on your own side.

    [bold]Examples[/bold]

      timberhand operator watch --profile aoro_fc8 --operator /run/timberhand-operator/controller
    """
    from can_dbc.messages.crane import OperatorAction
    from timberhand import terminal_watch

    machine, send = _sender(profile, operator)
    limit_ms = machine.timeouts.operator_link_ms
    if not limit_ms:
        raise CommandFailed(
            "operator.not-watched",
            f"{machine.name} watches no link (timeouts.operator_link_ms = 0); set 500 to 1000 in its profile",
        )
    print(f"Watching {machine.name}; Ctrl-C ends the watch. Without this terminal it holds after {limit_ms} ms.")
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(ExitCode.INTERRUPTED))  # not Ctrl-C, as it is elsewhere
    try:
        terminal_watch.watch(lambda stamp_ns: send(OperatorAction.WATCH, stamp_ns), limit_ms * 1_000_000)
    except KeyboardInterrupt:
        send(OperatorAction.WATCH_END, None)
        print("The watch is ended; the machine works on.")
    finally:
        signal.signal(signal.SIGTERM, before)


@app.command("unwatch")
def unwatch(profile: ProfileOption = "palms_471", operator: SocketOption = None) -> None:
    """End the watch on purpose, also one whose link is lost: then the machine can be armed without a watcher."""
    from can_dbc.messages.crane import OperatorAction

    _, send = _sender(profile, operator)
    send(OperatorAction.WATCH_END, None)


@app.command("password")
def password(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name to sign in with.")],
    role: Annotated[RoleName, typer.Option(help="What it may do: look; command; commission, too.")],
    file: Annotated[Path, typer.Option(metavar="FILE", help="Accounts: the page's --passwords.")],
) -> None:
    """Add an account of the operator's page, or give it another password or role.

    The password is asked for twice, or read from standard input when that is no terminal. The file keeps its
    Argon2id hash; it is replaced as a whole. A running page reads it at its next start.

    [bold]Examples[/bold]

      timberhand operator password anna --role operator --file page.passwords
    """
    from console.accounts import Role, account_line, with_account

    if sys.stdin.isatty():
        secret = typer.prompt("password", hide_input=True, confirmation_prompt=True, err=True)
    else:
        try:
            secret = sys.stdin.buffer.readline().rstrip(b"\r\n").decode()
        except UnicodeDecodeError:
            raise CommandFailed(
                "operator.password", "the password on standard input is no UTF-8 text; send it as UTF-8", ExitCode.USAGE
            ) from None
    try:
        line = account_line(name, Role[role.value.upper()], secret)
    except ConfigError as error:
        raise CommandFailed.from_error(error, ExitCode.USAGE) from None
    try:
        _replace(file, with_account(file.read_text() if file.exists() else "", line))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise CommandFailed(
            "operator.accounts-file", f"{file} cannot be changed ({reason}); choose another --file"
        ) from None
    print(f"{file}: {name} is {role.value}.")


def _replace(file: Path, text: str) -> None:
    """Write a file of secrets as a whole, readable by its owner only."""

    beside = file.with_name(f".{file.name}.new")
    beside.unlink(missing_ok=True)
    with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
        out.write(text)
        out.flush()
        os.fsync(out.fileno())
    beside.replace(file)


def _sender(profile: str, operator: Path | None) -> tuple[Profile, Callable[[OperatorAction, int | None], None]]:
    """Return the machine, and a function that sends an action with its stamp (None: now) to its controller."""
    import time

    from can_dbc.messages import operator_link
    from can_dbc.messages.crane import OperatorCommand
    from can_dbc.messages.datagrams import encode
    from machine.loading.profile_file import load_profile, profile_hash

    machine = load_profile(profile)
    code = profile_hash(machine)
    path = operator or (SERVICE_SOCKET if os.path.exists(SERVICE_SOCKET) else operator_link.default_path())

    def send(action: OperatorAction, stamp_ns: int | None) -> None:
        now_ns = time.monotonic_ns()
        command = OperatorCommand(
            now_ns // 1_000_000 & 0x7FFF_FFFF, code, now_ns if stamp_ns is None else stamp_ns, action
        )
        try:
            operator_link.send(encode(command), path)
        except OSError as error:
            raise CommandFailed(
                "operator.no-controller",
                f"the controller at {path} cannot be reached ({error.strerror}); start it, or give its --operator FILE",
                ExitCode.BUS,
            ) from None

    return machine, send
