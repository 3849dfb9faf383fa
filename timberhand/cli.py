"""The ``timberhand`` command.

Every command group lives in a module of ``timberhand.commands`` that imports nothing heavy until it runs, so
``timberhand --help`` answers at once.  Exit codes are the same everywhere (`host.exit_codes`).
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import CodedError
from timberhand.commands import (
    bench,
    calibrate,
    compile_tick,
    console,
    dbc,
    demo,
    doctor,
    experiment,
    hil,
    inject,
    mission,
    plan,
    plan_learn,
    record,
    recording,
    replay,
    report,
    service,
    sim,
    survey_camera,
    train,
    why,
)
from timberhand.deprecated import current_spelling

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
    """Options of the whole command."""


app.command("demo")(demo.demo)
app.command("calibrate")(calibrate.calibrate)
app.command("survey-camera")(survey_camera.survey_camera)
app.command("experiment")(experiment.experiment)
app.command("report")(report.report)
app.command("inject")(inject.inject)
app.command("replay")(replay.replay)
app.command("why")(why.why)
app.command("record")(record.record)
app.command("console")(console.console)
app.command("doctor")(doctor.doctor)
app.command("compile")(compile_tick.compile_tick)
app.add_typer(dbc.app, name="dbc")
app.add_typer(recording.app, name="recording")
app.add_typer(plan.app, name="plan")
plan.app.command("learn")(plan_learn.learn)
plan.app.command("demonstrate")(plan_learn.demonstrate)
app.add_typer(mission.app, name="mission")
app.add_typer(bench.app, name="bench")
app.add_typer(hil.app, name="hil")
app.add_typer(sim.app, name="sim")
app.add_typer(service.app, name="service")
app.add_typer(train.app, name="train")


def main() -> None:
    """Run the command line.

    An error that reaches a person is one line on stderr, ``timberhand: <sentence> [code]``, and the documented exit
    code.
    """
    # Small matrix products in many threads wait for each other: three times as slow on two processors.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # When the reader of a pipe ends (`timberhand ... | head`), end quietly instead of with a traceback.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # like Ctrl-C: exit code 130
    arguments, notes = current_spelling(sys.argv[1:])
    for note in notes:
        print(f"timberhand: {note}", file=sys.stderr)
    sys.argv[1:] = arguments
    try:
        app()
    except CommandFailed as failure:
        print(f"timberhand: {failure}{f' [{failure.code}]' if failure.code else ''}", file=sys.stderr)
        sys.exit(failure.exit_code)
    except CodedError as error:
        print(f"timberhand: {error} [{error.code}]", file=sys.stderr)
        sys.exit(ExitCode.CONFIGURATION)


if __name__ == "__main__":
    main()
