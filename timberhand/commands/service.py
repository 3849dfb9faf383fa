"""``timberhand service``: install, update, roll back and inspect the systemd services."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.exit_codes import CommandFailed, ExitCode

if TYPE_CHECKING:
    from host.release.updater import Updater

app = typer.Typer(no_args_is_help=True, help="Install, update, roll back, inspect and remove the systemd services.")
PERIOD_S = 1.0

Root = Annotated[Path | None, typer.Option(help="Install into the directory tree DIR instead of /.", metavar="DIR")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print the steps without executing them.")]


@app.command(
    epilog="Examples:  sudo timberhand service install --wheel timberhand-0.1.0-py3-none-any.whl  ·  "
    "timberhand service install --dry-run"
)
def install(
    wheel: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Wheel to install (default: built from this checkout).")
    ] = None,
    bundle: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Unpacked bundle to install, once its signature is checked.")
    ] = None,
    public_key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --bundle: the public key of its maker; it is kept.")
    ] = None,
    find_links: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Take all packages from DIR, without a network.")
    ] = None,
    from_environment: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Use the packages of this virtual environment.")
    ] = None,
    python: Annotated[str | None, typer.Option(metavar="PROGRAM", help="Python interpreter, 3.11 or newer.")] = None,
    cpu: Annotated[
        str | None,
        typer.Option(
            metavar="N", help="Processor of the controller, or any (default: as it is; first, an isolated one)."
        ),
    ] = None,
    root: Root = None,
    dry_run: DryRun = False,
) -> None:
    """Install program, units, users and settings; run it again to repair.  Starts and arms nothing.

    When the installed program runs this command, it repairs the installation
    around itself. From the wheel alone: sudo python3.11 timberhand-
    VERSION.whl/deploy
    """
    options = {
        "--wheel": wheel,
        "--bundle": bundle,
        "--public-key": public_key,
        "--find-links": find_links,
        "--from-environment": from_environment,
        "--python": python,
        "--cpu": cpu,
        "--root": root,
    }
    _script([word for name, value in options.items() if value is not None for word in (name, str(value))], dry_run)


@app.command()
def uninstall(root: Root = None, dry_run: DryRun = False) -> None:
    """Remove the installation; recordings, users and changed settings remain."""
    _script(["--uninstall", *(["--root", str(root)] if root else [])], dry_run)


@app.command()
def update(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", help="Bundle, a tar file, or a folder with its files.")],
) -> None:
    """Change to the release of a signed bundle, with a check and a way back.

    The bundle is installed into a tree of its own while the services run.
    Then they stop, the release changes with one rename, and they start
    again, disarmed. If controller and guard do not reach READY, STANDBY and
    GOOD within a minute, the former release comes back by itself. A power
    cut leaves the one or the other.

    Exit code 3 when the bundle is refused, 5 while the machine is armed, 6
    when the new release did not come up and the former one is in use again.

    [bold]Examples[/bold]

      sudo timberhand service update timberhand-0.2.0-3f2a91c07d15.tar
    """
    name = _updater().update(bundle.resolve())
    print(f"{name} is in use; nothing is armed")


@app.command()
def rollback() -> None:
    """Change back to the release before this one, with the same check.

    Exit codes as of update.
    """
    name = _updater().rollback()
    print(f"{name} is in use; nothing is armed")


@app.command()
def resume() -> None:
    """Finish an update that a power cut interrupted; the computer's start runs it.

    Exit code 6 when the new release did not come up and the former one is in
    use again.
    """

    try:
        print(f"{_updater().resume()} is in use")
    except CommandFailed as refused:
        if refused.code != "update.running":
            raise
        print("an update is running, which finishes by itself")  # it has started the services, and with them this


@app.command(
    epilog="Examples:  timberhand service status  ·  timberhand service status --watch  ·  "
    "timberhand service status --json | jq .timing.durations.wake"
)
def status(
    watch: Annotated[bool, typer.Option("--watch", help="Refresh once per second, until Ctrl-C.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON on stdout; with --watch one document per line.")
    ] = False,
    timing: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Timing page of the controller (default: that of the service).")
    ] = None,
) -> None:
    """Show the state of every service and the timing of the controller: ticks, wake-ups, input ages, buses, memory.

    p50, p99 and p99.9 are quantiles since the start of the controller; with
    --watch also those of the last second. Also works without systemd, for a
    controller started by hand.
    """
    from rich.console import Console
    from rich.live import Live

    from timberhand.service_status import read_status, screen

    console = Console(highlight=False)
    current_status, previous_timing = read_status(timing), None
    if not (watch or as_json or current_status.units or current_status.timing):
        raise CommandFailed("service.nothing-found", " ".join(current_status.notes))
    try:
        while as_json:
            print(json.dumps(current_status.named()), flush=True)
            if not watch:
                return
            time.sleep(PERIOD_S)
            current_status = read_status(timing)
        if not watch:
            console.print(screen(current_status))
            return
        with Live(console=console, auto_refresh=False, screen=console.is_terminal) as live:
            while True:
                live.update(screen(current_status, previous_timing), refresh=True)
                previous_timing = current_status.timing or previous_timing
                time.sleep(PERIOD_S)
                current_status = read_status(timing)
    except KeyboardInterrupt:
        raise typer.Exit(ExitCode.INTERRUPTED) from None


def _updater() -> Updater:

    from host.release.services import SystemdServices
    from host.release.trees import Trees
    from host.release.updater import PLACE, SIGNER, ReleaseProgram, Updater
    from timberhand.service_status import SYSTEMD

    for number in (signal.SIGHUP, signal.SIGPIPE):  # a lost terminal, or reader of the output, leaves nothing half done
        signal.signal(number, signal.SIG_IGN)
    if os.geteuid() != 0:
        raise CommandFailed("update.not-root", "this needs root; start it with sudo")
    if not SYSTEMD.is_dir():
        raise CommandFailed("update.no-systemd", "systemd does not run here")
    units = PLACE / "current" / "deploy" / "units"
    return Updater(
        Trees(PLACE),
        SIGNER,
        SystemdServices(units),
        ReleaseProgram(),
        lambda line: print(f"update: {line}", file=sys.stderr, flush=True),
    )


def _script(options: list[str], dry_run: bool) -> Any:
    from deploy.__main__ import install as run

    raise typer.Exit(run([*options, *(["--dry-run"] if dry_run else [])]))
