"""The ``timberhand`` command.

Every command group lives in a module of ``timberhand.commands`` that imports nothing heavy until it runs, so
``timberhand --help`` answers at once.  Exit codes are the same everywhere (`host.exit_codes`).
"""

from __future__ import annotations

import contextlib
import io
import os
import select
import signal
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import TimberhandError
from timberhand.commands import (
    bench,
    bench_tick,
    calibrate,
    config,
    console,
    dbc,
    demo,
    doctor,
    experiment,
    hil,
    inject,
    machine,
    mission,
    operator,
    plan,
    recording,
    release,
    replay,
    report,
    service,
    sim,
    survey_camera,
    train,
    why,
)

if TYPE_CHECKING:
    from controller.guard.layout import GuardConfigError

STDOUT = 1
SENTENCE = "Autonomous control of a log-loading forestry machine: crane control over CAN, planning, physics plant."
app = typer.Typer(
    name="timberhand",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help=SENTENCE,
    epilog="Exit codes: 0 success, 2 usage, 3 configuration, 4 bus, 5 safety stop, 6 figure missed, 130 interrupted.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"timberhand {version('timberhand')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=_print_version),
    ] = False,
) -> None:
    """Take the options of the whole command."""


app.command("demo")(demo.demo)
app.command("calibrate")(calibrate.calibrate)
app.command("survey-camera")(survey_camera.survey_camera)
app.command("experiment")(experiment.experiment)
app.command("campaign")(experiment.campaign)
app.command("report")(report.report)
app.command("inject")(inject.inject)
app.command("replay")(replay.replay)
app.command("why")(why.why)
app.command("record")(recording.record)
app.command("console")(console.console)
app.command("doctor")(doctor.doctor)
app.command("compile")(bench_tick.compile_tick)
app.add_typer(config.app, name="config")
app.add_typer(machine.app, name="machine")
app.add_typer(dbc.app, name="dbc")
app.add_typer(recording.app, name="recording")
app.add_typer(plan.app, name="plan")
app.add_typer(mission.app, name="mission")
app.add_typer(operator.app, name="operator")
app.add_typer(bench.app, name="bench")
app.add_typer(hil.app, name="hil")
app.add_typer(sim.app, name="sim")
app.add_typer(service.app, name="service")
app.add_typer(release.app, name="release")
app.add_typer(train.app, name="train")


def main() -> None:
    """Run the command line.

    An error that reaches a person is one line on stderr, ``timberhand: <sentence> [code]``, and the documented exit
    code.
    """
    # Small matrix products in many threads wait for each other: three times as slow on two processors.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGPIPE, _end_with_reader)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C: exit code 130
    if "--help" in sys.argv:
        from timberhand import option_help

        option_help.install()
    try:
        _run()
    except CommandFailed as failure:
        print(f"timberhand: {failure}{f' [{failure.code}]' if failure.code else ''}", file=sys.stderr)
        sys.exit(failure.exit_code)
    except Exception as error:  # not an exit: after a removal there is nothing left to import
        if not isinstance(error, _coded_errors()):
            raise
        print(f"timberhand: {error} [{error.code}]", file=sys.stderr)
        sys.exit(ExitCode.CONFIGURATION)
    finally:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # for what is written at the exit


def _end_with_reader(number: int, _: object) -> None:
    """End quietly when the reader of the output ends (`timberhand ... | head`), instead of with a traceback.

    The other side of a connection, as a browser or a bus, ends nothing: that is for whoever holds the connection.
    """
    output = select.poll()
    output.register(STDOUT, 0)
    if any(event & select.POLLERR for _, event in output.poll(0)):
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)


def _run() -> None:
    """Run the command; one whose packages are not installed here says which.

    Raises:
        CommandFailed: an optional package is missing.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file's name may be no text, and a terminal may lack a sign
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        app()
    except SystemExit as end:
        if isinstance(end.__context__, typer.Abort):  # Ctrl-C or the end of the input at a question: Typer says 1
            sys.exit(ExitCode.INTERRUPTED)
        raise
    except ModuleNotFoundError as error:
        if (extra := _extra_with(error.name or "")) is None:
            raise
        bundle = ", or install a bundle that was made with --with-plant" if extra == "sim" else ""
        raise CommandFailed(
            "package.missing",
            f"{error.name} is missing, which this command needs: pip install 'timberhand[{extra}]'{bundle}",
        ) from None


def _extra_with(module: str) -> str | None:
    """Find the optional group of packages that brings a module, which is named as its package; None when none does."""
    from importlib import metadata

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    with contextlib.suppress(metadata.PackageNotFoundError):
        groups = metadata.metadata("timberhand").get_all("Provides-Extra") or []
        for need in map(Requirement, metadata.requires("timberhand") or ()):
            if need.marker and canonicalize_name(need.name) == canonicalize_name(module.partition(".")[0]):
                return next((group for group in groups if need.marker.evaluate({"extra": group})), None)
    return None


def _coded_errors() -> tuple[type[TimberhandError], type[GuardConfigError]]:
    """Return the errors whose sentence is for the user; the guard, which shares no code with us, has its own."""
    from controller.guard.layout import GuardConfigError

    return TimberhandError, GuardConfigError


if __name__ == "__main__":
    main()
