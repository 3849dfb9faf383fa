"""``timberhand demo``: the main job, a log goes from the ground into the bunk."""

from __future__ import annotations

import json
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from host.exits import Exit, Stopped
from timberhand.commands.runs import Backend, enter_lab, new_directory


class PlcRole(StrEnum):
    """Who closes the joint loops when a PLC drives the valves."""

    REFERENCES = "references"
    VALVES = "valves"


class PlcLink(StrEnum):
    """How the bridge speaks to the PLC."""

    MODBUS = "modbus"
    UDP = "udp"


def demo(
    lockstep: Annotated[bool, typer.Option(help="Virtual time in one process, bit-identical for a seed.")] = False,
    seed: Annotated[int, typer.Option(help="Chooses the log and where it lies.")] = 1,
    bus: Annotated[
        Backend, typer.Option(help="vcan (in user-mode Linux if need be), the wire, or what is there.")
    ] = Backend.AUTO,
    profile: Annotated[str, typer.Option(help="A shipped profile or a TOML file.")] = "palms_471",
    truth: Annotated[str, typer.Option(help="The plant's hidden truth: nominal, sampled, or a TOML file.")] = "nominal",
    out: Annotated[
        Path | None, typer.Option(help="Directory of the run's logs (default: a new one under runs/).")
    ] = None,
    console: Annotated[bool, typer.Option(help="Serve the page that shows the crane.")] = True,
    console_port: Annotated[int, typer.Option(help="Port of the page on localhost.")] = 8471,
    limit_s: Annotated[float, typer.Option(help="Give up after so many seconds.")] = 300.0,
    patience: Annotated[int, typer.Option(help="How many stops the stand-in operator arms again after (live).")] = 20,
    plc: Annotated[bool, typer.Option(help="Through a PLC on Ethernet, as on paper A's machine.")] = False,
    plc_role: Annotated[
        PlcRole, typer.Option(help="The PLC closes the joint loops on our references, or passes our valves on.")
    ] = PlcRole.REFERENCES,
    plc_link: Annotated[PlcLink, typer.Option(help="Modbus/TCP or the cyclic datagram (live).")] = PlcLink.MODBUS,
    camera: Annotated[
        str, typer.Option(help="See the logs through this camera of the profile instead of being told where they lie.")
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")] = False,
) -> None:
    """A log goes from the ground into the bunk, over CAN.

    The exit code is 0 only if the log truly lies in the bunk, judged by the plant's physics.

    [bold]Examples[/bold]

      timberhand demo                        live, on the bus that is there, with the page

      timberhand demo --bus vcan --seed 3    live on real SocketCAN

      timberhand demo --lockstep --seed 3    the same job in virtual time

      timberhand demo --plc                  a PLC closes the joint loops, over Modbus/TCP

      timberhand demo --camera stick         the log is found by the camera on the stick
    """
    from rich.console import Console

    from machine.load import ProfileError, load_profile

    if not lockstep:
        enter_lab(bus)
    try:
        cameras = load_profile(profile).cameras
    except ProfileError as error:
        raise Stopped(Exit.CONFIGURATION, str(error)) from None
    if camera and (plc or camera not in cameras):
        known = "the emulated PLC shows no pictures" if plc else f"it has: {', '.join(cameras) or 'none'}"
        raise Stopped(Exit.USAGE, f"--camera {camera}: {profile} has no such camera for this run; {known}")
    directory = out or new_directory(f"{'lockstep' if lockstep else bus.value}{'-plc' if plc else ''}-seed{seed}")
    if plc:
        from hil.plc_profile import write_plc_profile

        profile = str(write_plc_profile(profile, plc_role.value, directory))
    screen = Console(stderr=as_json)
    if lockstep:
        from hil.demo import run_lockstep

        summary = run_lockstep(profile, seed, truth, directory, limit_s, screen, camera)
    else:
        from hil.demo import run_live

        page = console_port if console else 0
        summary = run_live(
            profile, seed, truth, bus.value, directory, page, limit_s, patience, screen, plc_link.value, camera
        )
    summary.show(screen)
    summary.save(directory / "summary.json")
    if as_json:
        print(json.dumps(asdict(summary)))
    raise typer.Exit(summary.exit)
