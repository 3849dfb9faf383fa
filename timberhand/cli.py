"""The ``timberhand`` command.

Every command group lives in a module of ``timberhand.commands`` that imports nothing heavy until it runs, so
``timberhand --help`` answers at once.  Exit codes are the same everywhere (``timberhand.exits``).
"""

from __future__ import annotations

import os
import signal
import sys

import typer

from host.exits import Stopped
from timberhand.commands import (
    bench,
    calibrate,
    console,
    dbc,
    demo,
    doctor,
    experiment,
    hil,
    log,
    mission,
    plan,
    plan_learn,
    record,
    replay,
    report,
    service,
    sim,
    survey_camera,
    train,
)

SENTENCE = "Drives a log-loading forestry machine by itself: crane control over CAN, planning, and a physics plant."
app = typer.Typer(
    name="timberhand",
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help=SENTENCE,
    epilog="Exit codes: 0 fine, 2 usage, 3 configuration, 4 bus, 5 stopped by safety, 6 figure not reached, "
    "130 interrupted.",
)
app.command("demo")(demo.demo)
app.command("calibrate")(calibrate.calibrate)
app.command("survey-camera")(survey_camera.survey_camera)
app.command("experiment")(experiment.experiment)
app.command("report")(report.report)
app.command("replay")(replay.replay)
app.command("record")(record.record)
app.command("console")(console.console)
app.command("doctor")(doctor.doctor)
app.add_typer(dbc.app, name="dbc")
app.add_typer(log.app, name="log")
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
    """Run the command line; an error of ours is one sentence on stderr and its documented exit code."""
    # Small products of matrices in many threads wait for each other; on two processors that takes three times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A reader that goes away (`timberhand ... | head`) ends us quietly instead of with a traceback.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # asked to end is the same as Ctrl-C: exit code 130
    try:
        app()
    except Stopped as stop:
        print(f"timberhand: {stop}", file=sys.stderr)
        sys.exit(stop.code)


if __name__ == "__main__":
    main()
