"""``timberhand doctor``: check this installation and the real-time readiness of this computer."""

from __future__ import annotations

import json
import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import JsonOption, refuse_without_effect


class LoopbackBus(StrEnum):
    """The bus of the measurement."""

    AUTO = "auto"
    VCAN = "vcan"
    WIRE = "wire"


def doctor(
    context: typer.Context,
    rt: Annotated[
        bool, typer.Option("--rt", help="Also check the computer's real-time settings and suggest changes.")
    ] = False,
    cpu: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="Processor of the controller (default: from the settings)."),
    ] = None,
    as_json: JsonOption = False,
    report: Annotated[
        bool, typer.Option("--report", help="Measure the control loop here and write a report to send.")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="FILE", help="With --report: the file to write.")] = Path(
        "real-time-report.md"
    ),
    seconds: Annotated[float, typer.Option(metavar="S", min=1.0, help="With --report: time to measure.")] = 60.0,
    bus: Annotated[
        LoopbackBus, typer.Option(help="With --report: the loopback bus; auto is vcan where it exists and is up.")
    ] = LoopbackBus.AUTO,
    profile: Annotated[str, typer.Option(help="With --report: the machine to emulate.")] = "aoro_fc8",
) -> None:
    """Check this installation and, with --rt, this computer's real-time settings.

    Suggests changes, the most useful first. Exit code 3 only when something
    prevents every run.

    [bold]Examples[/bold]

      timberhand doctor

      timberhand doctor --rt --cpu 3

      sudo timberhand doctor --rt --report
    """
    from rich.console import Console

    from host.doctor import facts, installation, timing
    from host.doctor.finding import Severity, conclusion, show

    if report:
        refuse_without_effect(context, ("cpu", "as_json"), "with --report")
        _report(out, seconds, bus, profile)
        return
    refuse_without_effect(context, ("out", "seconds", "bus", "profile"), "without --report")
    if not rt:
        refuse_without_effect(context, ("cpu",), "without --rt")
    groups = {"installation": installation.examine()}
    if rt:
        groups["timing"] = timing.evaluate(facts.read(Path("/"), _links(), cpu))
    every = [finding for group in groups.values() for finding in group]
    if as_json:
        print(json.dumps({name: [f.document() for f in group] for name, group in groups.items()}, indent=2))
    else:
        console = Console(highlight=False)
        for name, group in groups.items():
            show(console, f"timberhand {name}", group)
        console.print(conclusion(every))
    raise typer.Exit(ExitCode.CONFIGURATION if any(f.severity is Severity.FAULT for f in every) else ExitCode.OK)


def _links() -> str:
    """List the interfaces by ip(8); none without it."""
    import shutil
    import subprocess

    ip = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    if ip is None:
        return "[]"
    answer = subprocess.run([ip, "-details", "-statistics", "-json", "link"], capture_output=True, text=True)
    return answer.stdout or "[]"


def _report(out: Path, seconds: float, bus: LoopbackBus, profile: str) -> None:
    """Measure and write the report; exit code 6 for an unfit computer, 3 when the report cannot be written."""
    import platform
    import tempfile

    from rich.console import Console

    from experiments.timing.fitness import Measured, Verdict, data_of, loopback_bus, measure_computer, text_of
    from experiments.timing.testbed import cores
    from host.doctor import facts, timing

    try:
        out.touch()
    except OSError as error:
        raise CommandFailed(
            "doctor.no-report", f"the report {out} cannot be written: {error.strerror}; use --out"
        ) from None
    cpu = cores()[0]
    host_facts = facts.read(Path("/"), _links(), cpu)
    machine = facts.read_computer(Path("/"), platform.version(), cpu)
    chosen = loopback_bus(profile) if bus is LoopbackBus.AUTO else bus.value
    console = Console(highlight=False)
    with tempfile.TemporaryDirectory(prefix="timberhand-report-") as folder, console.status("") as status:
        try:
            measured: Measured | str = measure_computer(
                host_facts,
                profile,
                chosen,
                seconds,
                Path(folder),
                lambda step: status.update(f"real-time report: {step}"),
            )
        except CommandFailed as failure:
            measured = f"the measurement failed: {failure}"
    data = data_of(host_facts, machine, timing.evaluate(host_facts), measured, _private())
    out.write_text(text_of(data))
    for judged in data["judgements"]:
        console.print(f"{judged['verdict']:>12}  {judged['topic']}: {judged['sentence']}", soft_wrap=True)
        if judged["advice"]:
            console.print(f"{'':12}  -> {judged['advice']}", soft_wrap=True)
    console.print(
        f"Verdict: {data['verdict']}. The report is in {out}; it holds no names and no paths.", soft_wrap=True
    )
    raise typer.Exit(ExitCode.FIGURE_MISSED if data["verdict"] == Verdict.UNFIT else ExitCode.OK)


def _private() -> frozenset[str]:
    """Return the names that a report must not hold."""
    import contextlib
    import platform
    import pwd

    from experiments.timing.fitness import private_words

    users = [os.environ.get(name, "") for name in ("USER", "LOGNAME", "SUDO_USER")]
    with contextlib.suppress(KeyError):  # no entry in the user database
        users.append(pwd.getpwuid(os.getuid()).pw_name)
    host = platform.node()
    return private_words(host, host.partition(".")[0], *users)
