"""``timberhand demo``: the crane lays one log from the ground into the bunk."""

from __future__ import annotations

import json
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import (
    FoxglovePortOption,
    MaxStopsOption,
    PageOption,
    PagePortOption,
    ProfileOption,
    SummaryOption,
    TruthOption,
    truth_of,
)
from timberhand.commands.runs import Backend, BusOption, ClockChoice, ClockOption, enter_lab, new_directory


class PlcRole(StrEnum):
    """What a PLC that drives the valves is given."""

    REFERENCES = "references"
    VALVES = "valves"


class PlcLink(StrEnum):
    """Protocol between bridge and PLC."""

    MODBUS = "modbus"
    UDP = "udp"


def demo(
    lockstep: Annotated[
        bool, typer.Option(help="Run in virtual time in one process; a seed gives the same bytes every time.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Chooses the log and its pose.")] = 1,
    bus: BusOption = Backend.AUTO,
    clock: ClockOption = ClockChoice.AUTO,
    profile: ProfileOption = "palms_471",
    truth: TruthOption = "nominal",
    out: Annotated[
        Path | None, typer.Option(help="Directory of the recording (default: a new one below runs/).")
    ] = None,
    console: PageOption = True,
    console_port: PagePortOption = 8471,
    foxglove: FoxglovePortOption = 0,
    limit_s: Annotated[float, typer.Option(help="Time limit of the job in seconds.")] = 300.0,
    max_stops: MaxStopsOption = 20,
    plc: Annotated[bool, typer.Option(help="Drive the valves through a PLC on Ethernet, as in paper A.")] = False,
    plc_role: Annotated[
        PlcRole,
        typer.Option(help="references: the PLC closes the joint loops; valves: it passes valve commands on."),
    ] = PlcRole.REFERENCES,
    plc_link: Annotated[PlcLink, typer.Option(help="Modbus/TCP or cyclic UDP datagrams (live).")] = PlcLink.MODBUS,
    camera: Annotated[
        str, typer.Option(help="Detect the logs with this camera of the profile (default: true log poses).")
    ] = "",
    faults: Annotated[
        list[str] | None,
        typer.Option(
            "--inject", help="Fault to inject, as in encoder-lift:stuck@12.3s (lockstep); see timberhand inject."
        ),
    ] = None,
    as_json: SummaryOption = False,
) -> None:
    """Lay one log from the ground into the bunk, over CAN.

    Exit code 0 only when the log lies in the bunk according to the plant's
    physics.

    [bold]Examples[/bold]

      timberhand demo                        live, with the operator's page

      timberhand demo --bus vcan --seed 3    live on SocketCAN

      timberhand demo --lockstep --seed 3    the same job in virtual time

      timberhand demo --plc                  a PLC closes the joint loops

      timberhand demo --camera stick         a camera detects the log
    """
    from rich.console import Console

    from machine.loading.profile_file import ProfileError, load_profile

    if not lockstep:
        enter_lab(bus, clock, detects=bool(camera))
    try:
        cameras = load_profile(profile).cameras
    except ProfileError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    if camera and plc:
        raise CommandFailed(
            "demo.camera-with-plc",
            f"--camera {camera}: the emulated PLC has no camera; use --camera or --plc, not both",
            ExitCode.USAGE,
        )
    if camera and camera not in cameras:
        raise CommandFailed(
            "demo.no-camera",
            f"--camera {camera}: profile {profile} has no such camera; it has: {', '.join(cameras) or 'none'}",
            ExitCode.USAGE,
        )
    if faults and not lockstep:
        raise CommandFailed(
            "demo.inject-live",
            "--inject needs --lockstep; in a live run use `timberhand inject` from another terminal",
            ExitCode.USAGE,
        )
    truth = truth_of(profile, truth)
    directory = out or new_directory(f"{'lockstep' if lockstep else bus.value}{'-plc' if plc else ''}-seed{seed}")
    if plc:
        from hil.plc.profile import write_plc_profile

        profile = str(write_plc_profile(profile, plc_role.value, directory))
    screen = Console(stderr=as_json)
    if lockstep:
        from hil.demo.lockstep import run_lockstep
        from hil.faults.order import parse
        from hil.faults.table import FaultError

        try:
            orders = [parse(text, seed) for text in faults or ()]
            summary = run_lockstep(profile, seed, truth, directory, limit_s, screen, camera, orders)
        except FaultError as error:
            raise CommandFailed.from_error(error, ExitCode.USAGE) from None
    else:
        from hil.demo.live import run_live

        page = console_port if console else 0
        summary = run_live(
            profile,
            seed,
            truth,
            bus.value,
            directory,
            page,
            limit_s,
            max_stops,
            screen,
            plc_link.value,
            camera,
            foxglove,
        )
    summary.show(screen)
    summary.save(directory / "summary.json")
    if as_json:
        print(json.dumps(asdict(summary)))
    raise typer.Exit(summary.exit_code)
