"""``timberhand record``: run the recorder; ``timberhand recording``: recorded CAN traffic in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import LinkError
from timberhand.commands.options import JsonOption, ProfileOption

if TYPE_CHECKING:
    from can_dbc.trace.decoder import Decoder
    from can_dbc.trace.records import Trace

app = typer.Typer(no_args_is_help=True, help="Read CAN recordings.")


def record(
    out: Annotated[Path, typer.Option(help="Directory of the recording; it must not hold one already.")],
    bus: Annotated[
        list[str] | None,
        typer.Option(help="NAME=ADDRESS of a bus; may be repeated (default: the buses of the profile)."),
    ] = None,
    report_port: Annotated[
        int, typer.Option(min=0, max=65535, help="UDP port of the controller's state reports.")
    ] = 8474,
    profile: ProfileOption = "palms_471",
    ticks: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Ring of the controller's tick records in shared memory.")
    ] = None,
    timing: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Timing page of the controller, recorded once per second.")
    ] = None,
    key_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File with the key that authenticates datagrams (default: that of the installed services).",
        ),
    ] = None,
) -> None:
    """Record the buses, the controller's ticks and its reports until Ctrl-C.

    [bold]Examples[/bold]

      timberhand record --out runs/field-1

      timberhand record --out runs/field-1 --bus crane0=socketcan:can0

      timberhand record --out runs/field-1 --report-port 5006 --key-file key
    """
    from can_dbc.bus.factory import default_address
    from machine.loading.profile_file import load_profile
    from recorder.__main__ import main

    try:
        machine = load_profile(profile)
        names = [name for name in (machine.crane_bus, machine.machine_bus) if name]
        buses = bus or [f"{name}={default_address(name)}" for name in names]
    except LinkError as error:
        raise CommandFailed.from_error(error, ExitCode.BUS) from error
    arguments = ["--out", str(out), "--report-port", str(report_port), *(("--ticks", str(ticks)) if ticks else ())]
    arguments += ["--timing", str(timing)] if timing else []
    arguments += ["--key-file", str(key_file)] if key_file else []
    code = main([*arguments, "--profile", profile, *(x for b in buses for x in ("--bus", b))])
    raise typer.Exit(code)


@app.callback()
def group() -> None:
    """Keep ``decode`` a subcommand although it is the only one."""


@app.command(
    epilog="Examples:  timberhand recording decode drive.log --dbc gnss  ·  "
    "timberhand recording decode crane.blf --dbc crane --json"
)
def decode(
    recording: Annotated[Path, typer.Argument(metavar="FILE", help="candump, PCAN (.trc) or YDWG text, .asc, .blf.")],
    dbc: Annotated[
        list[str] | None,
        typer.Option(
            "--dbc", metavar="FILE", help="DBC or KCD path, or shipped: crane, machine, gnss; may be repeated."
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print the counts only.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Decode a CAN recording with one or more databases (default: all shipped ones), with the fast packets of
    NMEA 2000 and the transport protocol of J1939.  Each interface of the recording is a bus of its own.

    Malformed lines are counted and not fatal; a frame out of range or with a
    bad CRC is shown and counted. A file in which no frame can be read ends
    with exit code 3.
    """
    from can_dbc.dbc.codec import SHIPPED
    from can_dbc.trace.candump import read_trace
    from can_dbc.trace.decoder import Decoder

    try:
        decoder = Decoder(dbc or list(SHIPPED))
        records = read_trace(recording)
    except OSError as error:
        raise CommandFailed("recording.unreadable", f"{recording}: cannot be read: {error.strerror}") from error
    if as_json:
        separator = '{"frames": ['
        for entry in decoder.run(records):
            if not quiet:
                typer.echo(separator + json.dumps(entry.as_dict(), allow_nan=False))
                separator = ","
        _refuse_nothing(recording, decoder, records)
        head = separator if separator != "," else ""
        typer.echo(f'{head}], "summary": {json.dumps(decoder.summary() | {"notes": records.notes})}}}')
        return
    _print(recording, decoder, records, quiet)


def _refuse_nothing(recording: Path, decoder: Decoder, records: Trace) -> None:
    """Raise CommandFailed for a file in which no frame could be read."""
    from hil.replay.recording import no_frames

    if not decoder.counts["frames"]:
        raise no_frames(recording, [*decoder.broken_examples[:1], *records.notes])


def _print(recording: Path, decoder: Decoder, records: Trace, quiet: bool) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(soft_wrap=True, highlight=False)
    for entry in decoder.run(records):
        if not quiet:
            mark = f"  [red]{escape(entry.fault)}[/red]" if entry.fault else ""
            name = escape(f"{entry.name:<20}")
            stamp = f"{entry.stamp_ns / 1e9:17.6f}"
            interface = escape(f" {entry.interface}" if entry.interface else "")
            console.print(
                f"[dim]{stamp}{interface} {entry.identifier:>8}[/dim] [cyan]{name}[/cyan] {escape(entry.text())}{mark}"
            )
    _refuse_nothing(recording, decoder, records)
    summary = decoder.summary()
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("message")
    table.add_column("frames", justify="right")
    for name, count in summary["messages"].items():
        table.add_row(escape(name), str(count))
    console.print(table)
    console.print(
        f"{summary['frames']} frames, {summary['decoded']} messages decoded, {summary['unknown']} frames unknown, "
        f"{summary['refused']} refused, {summary['bad_crc']} with a bad CRC, "
        f"{summary['error_frames']} error frames, {summary['remote_frames']} remote frames, "
        f"{summary['lost_fast_packets']} fast packets lost, {summary['broken']} malformed records"
    )
    if any(
        summary[name] for name in ("transported", "lost_transported", "unopened_transported", "extended_transported")
    ):
        console.print(
            f"J1939 transport protocol: {summary['transported']} messages, {summary['unknown_transported']} of them "
            f"unknown, {summary['lost_transported']} lost, {summary['unopened_transported']} frames of data without an "
            f"opening, {summary['extended_transported']} messages of the extended protocol not decoded"
        )
    if len(summary["interfaces"]) > 1:
        counts = ", ".join(f"{name} {count} frames" for name, count in summary["interfaces"].items())
        console.print(escape(f"interfaces, decoded apart: {counts}"))
    for note in records.notes:
        console.print(escape(note))
    for text in summary["broken_examples"]:
        console.print(f"[yellow]malformed[/yellow] {escape(text)}")
