"""``timberhand demo``: the crane lays one log from the ground into the bunk."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import (
    LIVE_ONLY,
    FoxglovePortOption,
    GraspPlannerOption,
    MaxStopsOption,
    PageOption,
    PagePortOption,
    PlanPicturesOption,
    ProfileOption,
    SummaryOption,
    TruthOption,
    VirtualCamerasOption,
    planner_of,
    refuse_without_effect,
    truth_of,
)
from timberhand.commands.runs import Backend, BusOption, ClockChoice, ClockOption, end, enter_lab, new_directory

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from host.real_time import Finding


class PlcRole(StrEnum):
    """What a PLC that drives the valves is given."""

    REFERENCES = "references"
    VALVES = "valves"


class Detector(StrEnum):
    """What finds the logs."""

    OWN = "own"
    PERFECT = "perfect"


class PlcLink(StrEnum):
    """Protocol between bridge and PLC."""

    MODBUS = "modbus"
    UDP = "udp"


def demo(
    context: typer.Context,
    lockstep: Annotated[
        bool, typer.Option(help="Run in virtual time in one process; a seed gives the same bytes every time.")
    ] = False,
    live: Annotated[
        bool | None,
        typer.Option(
            "--live/--no-live",
            help="In real time, or in paced virtual time with the page (default: on the wire, as this computer can).",
        ),
    ] = None,
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
    detector: Annotated[
        Detector,
        typer.Option(help="What finds the logs: a camera of the machine; perfect cheats with the plant's truth."),
    ] = Detector.OWN,
    camera: Annotated[
        str, typer.Option(help="Which camera of the profile (default: the first one that sees the crane's work).")
    ] = "",
    planner: GraspPlannerOption = "search",
    virtual_cameras: VirtualCamerasOption = 1,
    plan_pictures: PlanPicturesOption = None,
    paper_a: Annotated[
        bool,
        typer.Option(
            "--paper-a",
            help="Paper A's machine whole: the camera on the stick, its network, the loops in a PLC at 50 Hz; as "
            "--camera stick --planner cnn --plc.",
        ),
    ] = False,
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
    physics. On a computer that does not hold the period of a live run the demo
    runs in paced virtual time, and says so.

    [bold]Examples[/bold]

      timberhand demo                        live, with the operator's page

      timberhand demo --bus vcan --seed 3    live on SocketCAN

      timberhand demo --live                 live, however busy this computer is

      timberhand demo --lockstep --seed 3    the same job in virtual time

      timberhand demo --plc                  a PLC closes the joint loops

      timberhand demo --detector perfect     without the camera: less work for this computer

      timberhand demo --planner cnn          paper A's network plans the grasp

      timberhand demo --paper-a --lockstep   paper A's machine, whole
    """
    from rich.console import Console

    from autonomy.crane_job.rotator_estimate import VEHICLE_LINKS
    from machine.loading.profile_file import load_profile

    if lockstep:
        refuse_without_effect(context, (*LIVE_ONLY, "plc_link"), "with --lockstep")
    if not (plc or paper_a):
        refuse_without_effect(context, ("plc_role", "plc_link"), "without --plc")
    if detector is Detector.PERFECT:
        refuse_without_effect(context, ("camera",), "with --detector perfect")
    if not console:
        refuse_without_effect(context, ("console_port", "foxglove"), "with --no-console")
    if bus not in (Backend.VCAN, Backend.PYTHON_CAN):
        refuse_without_effect(context, ("clock",), f"with --bus {bus.value}")
    if refused := refusal(live, lockstep, bus, plc and plc_link is PlcLink.UDP):
        raise refused
    if paper_a:
        chosen_already = profile != "palms_471" or planner != "search" or camera or detector is Detector.PERFECT
        if chosen_already or plc_role is not PlcRole.REFERENCES:
            raise CommandFailed(
                "demo.paper-a",
                "--paper-a chooses machine, camera, planner and the PLC's role; leave out --profile, --detector, "
                "--camera, --planner and --plc-role",
                ExitCode.USAGE,
            )
        camera, planner, plc = "stick", "cnn", True
    chosen = planner_of(planner, virtual_cameras, plan_pictures)
    machine = load_profile(profile)
    cameras = machine.cameras
    cheats = ""
    if detector is Detector.PERFECT:
        cheats = "--detector perfect cheats: the planner is told where the logs truly lie"
    elif not camera:
        camera = next((name for name, each in cameras.items() if each.link not in VEHICLE_LINKS), "")
        cheats = (
            ""
            if camera
            else (f"{profile} has no camera that sees the crane's work: the planner is told where the logs truly lie")
        )
    if not lockstep:
        enter_lab(bus, clock, detects=bool(camera))
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
    screen = Console(stderr=as_json)
    if cheats:
        screen.print(cheats, style="yellow", markup=False, soft_wrap=True)
    if lockstep or live is not None:
        paced = live is False
    else:
        from hil.harness.live import uses_wire

        on_wire = "TIMBERHAND_LAB" not in os.environ and uses_wire(machine, bus.value)
        paced = on_wire and _paces(screen, plc and plc_link is PlcLink.UDP, 1.0 if camera else 0.0)
    kind = "lockstep" if lockstep else "paced" if paced else bus.value
    directory = out or new_directory(f"{kind}{'-plc' if plc else ''}-seed{seed}")
    if plc:
        from hil.plc import write_plc_profile

        profile = str(write_plc_profile(profile, plc_role.value, directory))
    page = console_port if console else 0
    if lockstep:
        from hil.demo.lockstep import run_lockstep
        from hil.faults.table import parse
        from runtime.errors import InputRefused

        try:
            orders = [parse(text, seed) for text in faults or ()]
            summary = run_lockstep(profile, seed, truth, directory, limit_s, screen, camera, orders, planner=chosen)
        except InputRefused as error:
            raise CommandFailed.from_error(error, ExitCode.USAGE) from None
    elif paced:
        from hil.demo.paced import run_paced

        summary = run_paced(
            profile,
            seed,
            truth,
            directory,
            page,
            limit_s,
            max_stops,
            screen,
            camera,
            foxglove,
            chosen,
        )
    else:
        from hil.demo.live import run_live

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
            chosen,
        )
    end(summary, screen, directory, as_json)


def refusal(live: bool | None, lockstep: bool, bus: Backend, udp: bool) -> CommandFailed | None:
    """Say why ``--live`` or ``--no-live`` cannot be followed; None when it can.  ``udp``: a PLC linked by datagrams."""
    if live is None:
        return None
    option = "--live" if live else "--no-live"
    if lockstep:
        return CommandFailed(
            "demo.live-lockstep",
            f"{option}: a run with --lockstep has no other time than its own; use one of the two",
            ExitCode.USAGE,
        )
    if bus in (Backend.VCAN, Backend.PYTHON_CAN):
        return CommandFailed(
            "demo.live-vcan",
            f"{option} is for the wire; on vcan use --clock real or --clock simulated",
            ExitCode.USAGE,
        )
    if udp and not live:
        return CommandFailed(
            "demo.paced-udp",
            "--no-live: the PLC's cyclic datagrams exist in a live run alone; use --plc-link modbus",
            ExitCode.USAGE,
        )
    return None


def paced_or_live(finding: Finding, live_only: bool, more: float = 0.0) -> tuple[bool, str]:
    """Tell whether the demo is paced on a computer of which a look found ``finding``, and what to say.

    ``live_only``: what was asked for exists in a live run alone; ``more``: processors that it needs besides.
    """
    from host.real_time import obstacle

    obstacle_text = obstacle(finding, more)
    if not obstacle_text:
        return False, ""
    if live_only:
        return False, f"{obstacle_text}: the machine may stop, and --plc-link udp exists live alone."
    return True, f"{obstacle_text}: the demo runs in paced virtual time instead; --live insists."


def _paces(screen: RichConsole, live_only: bool, more: float) -> bool:
    """Look at this computer, and tell the user what that means where it cannot hold a live run."""
    from hil.harness.display import say
    from host.real_time import look

    with screen.status("Does this computer hold the period of a live run?"):
        finding = look()
    paced, sentence = paced_or_live(finding, live_only, more)
    if sentence:
        say(screen, "", sentence, "yellow")
    return paced
