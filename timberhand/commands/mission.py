"""``timberhand mission``: run a whole forwarding mission, order one of a running planner, document the manager."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from host.exit_codes import CommandFailed
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
    Terrain,
    TerrainOption,
    TruthOption,
    VirtualCamerasOption,
    planner_of,
    refuse_without_effect,
    truth_of,
)
from timberhand.commands.runs import Backend, BusOption, ClockChoice, ClockOption, end, enter_lab, new_directory

if TYPE_CHECKING:
    from machine.profile import Profile
    from timberhand.mission_orders import PlannerOrders

app = typer.Typer(no_args_is_help=True, help="Run a forwarding mission, or order one of a running planner.")
MISSIONS: Final = Path("/var/lib/timberhand-missions")
"""The folder that the services share."""
ORDER_PORT: Final = 24705
"""As the shipped settings show it."""


class ManagerKind(StrEnum):
    """The activity manager, with its steering law."""

    OWN = "own"
    PAPER_B = "paper-b"


class DetectorKind(StrEnum):
    """The detector that finds the logs."""

    OWN = "own"
    PAPER_B = "paper-b"
    PERFECT = "perfect"


TABLES: Final = {ManagerKind.OWN: "ours", ManagerKind.PAPER_B: "paper-b"}
"""Names of the transition tables (`autonomy.manager.transition_table`)."""
DETECTORS: Final = {DetectorKind.PERFECT: "perfect", DetectorKind.PAPER_B: "faithful", DetectorKind.OWN: "ours"}
"""Names of the detectors (`hil.missions.detectors`)."""


@app.command()
def run(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Mission file, in any format of `timberhand plan`.")],
    lockstep: Annotated[
        bool, typer.Option(help="Run in virtual time in one process; a seed gives the same bytes every time.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Chooses the logs' properties and the noise of the plant.")] = 1,
    manager: Annotated[
        ManagerKind, typer.Option(help="Activity manager and steering law: our own, or those of paper B.")
    ] = ManagerKind.OWN,
    detector: Annotated[
        DetectorKind,
        typer.Option(
            help="What finds the logs: the front camera with our own or paper B's pipeline; perfect cheats with the "
            "plant's truth."
        ),
    ] = DetectorKind.OWN,
    planner: GraspPlannerOption = "search",
    virtual_cameras: VirtualCamerasOption = 1,
    plan_pictures: PlanPicturesOption = None,
    logs: Annotated[
        int, typer.Option(min=0, help="Lay this many logs along the route instead of those of the mission.")
    ] = 0,
    profile: ProfileOption = "aoro_fc8",
    truth: TruthOption = "nominal",
    terrain: TerrainOption = Terrain.FLAT,
    out: Annotated[
        Path | None, typer.Option(help="Directory of the recording (default: a new one below runs/).")
    ] = None,
    bus: BusOption = Backend.AUTO,
    clock: ClockOption = ClockChoice.AUTO,
    console: PageOption = True,
    console_port: PagePortOption = 8471,
    foxglove: FoxglovePortOption = 0,
    max_stops: MaxStopsOption = 20,
    limit_s: Annotated[float, typer.Option(help="Time limit of the mission in seconds of machine time.")] = 7200.0,
    as_json: SummaryOption = False,
) -> None:
    """Drive the route of a mission, collect the logs and bring them to the end of the route.

    Exit code 0 when the mission is finished and all loaded logs lie in the bunk
    according to the plant's physics.

    [bold]Examples[/bold]

      timberhand mission run docs/examples/paper_b.geojson --lockstep

      timberhand mission run docs/examples/paper_b.geojson --lockstep --terrain drawn

      timberhand mission run docs/examples/paper_b.geojson --bus vcan

      timberhand mission run docs/examples/paper_b.geojson --detector perfect

      timberhand mission run docs/examples/paper_b_angled.geojson --manager paper-b
    """
    from rich.console import Console

    from autonomy.missions.mission_file import load_mission
    from machine.loading.profile_file import load_profile

    if lockstep:
        refuse_without_effect(context, LIVE_ONLY, "with --lockstep")
    if not console:
        refuse_without_effect(context, ("console_port", "foxglove"), "with --no-console")
    if bus not in (Backend.VCAN, Backend.PYTHON_CAN):
        refuse_without_effect(context, ("clock",), f"with --bus {bus.value}")
    chosen = planner_of(planner, virtual_cameras, plan_pictures)
    if not lockstep:
        enter_lab(bus, clock, detects=detector is not DetectorKind.PERFECT)
    machine = load_profile(profile)
    carrier = machine.carrier
    site = None if carrier is None else (carrier.site_lat_deg, carrier.site_lon_deg)
    draft = load_mission(file, route_wanted=True, site=site)
    truth = truth_of(profile, truth)
    directory = out or new_directory(f"mission-{file.stem}-{manager.value}-seed{seed}")
    screen = Console(stderr=as_json)
    mission = draft.mission
    for note in draft.notes:
        screen.print(f"note: {note}", style="yellow", markup=False, soft_wrap=True)
    for problem in draft.warnings:
        screen.print(f"warning: {problem}", style="yellow", markup=False, soft_wrap=True)
    if detector is DetectorKind.PERFECT:
        screen.print("--detector perfect cheats: the planner is told where the logs truly lie", style="yellow")
    if lockstep:
        from hil.missions.lockstep import run_mission

        summary = run_mission(
            mission,
            profile,
            seed,
            truth,
            TABLES[manager],
            logs,
            directory,
            limit_s,
            screen,
            DETECTORS[detector],
            terrain.value,
            chosen,
        )
    else:
        from hil.harness.live import LiveOptions
        from hil.missions.live import run_live_mission

        page = console_port if console else 0
        options = LiveOptions(
            profile, machine, seed, truth, bus.value, directory, page, limit_s, max_stops, foxglove_port=foxglove
        )
        summary = run_live_mission(
            file, mission, options, TABLES[manager], logs, screen, terrain.value, DETECTORS[detector], chosen
        )
    end(summary, screen, directory, as_json)


OrderPortOption = Annotated[int, typer.Option(min=1, max=65535, help="The planner's --order-port on this computer.")]
KeyOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Key of the planner (default: that of the installed services).")
]


@app.command()
def start(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Mission file, in any format of `timberhand plan`.")],
    profile: ProfileOption = "aoro_fc8",
    missions: Annotated[Path, typer.Option(metavar="DIR", help="The planner's folder of missions.")] = MISSIONS,
    order_port: OrderPortOption = ORDER_PORT,
    key_file: KeyOption = None,
) -> None:
    """Give a mission to the planner that runs on this computer, and set it to Auto.

    The machine must stand and must not be armed; it drives when an operator arms it. The mission
    is checked as by `timberhand plan check` first. Exit code 3: the mission is refused; 4: no planner
    answers; 5: the planner refuses now.

    [bold]Examples[/bold]

      sudo timberhand mission start route.geojson --profile /etc/timberhand/forwarder.toml
    """
    from timberhand.mission_orders import checked

    machine, orders = _orders(profile, order_port, key_file)
    report = orders.start(checked(file, machine), f"{file.stem}.geojson", missions)
    print(f"{report.name or file.stem}: {report.words}; arm the machine to begin")


@app.command()
def pause(
    profile: ProfileOption = "aoro_fc8", order_port: OrderPortOption = ORDER_PORT, key_file: KeyOption = None
) -> None:
    """Pause the mission of the planner that runs on this computer: crane and machine come to rest."""
    _order("PAUSE", profile, order_port, key_file)


@app.command()
def resume(
    profile: ProfileOption = "aoro_fc8", order_port: OrderPortOption = ORDER_PORT, key_file: KeyOption = None
) -> None:
    """Set the mission to Auto again, after a pause or a restart of the planner."""
    _order("AUTO", profile, order_port, key_file)


@app.command()
def abort(
    profile: ProfileOption = "aoro_fc8", order_port: OrderPortOption = ORDER_PORT, key_file: KeyOption = None
) -> None:
    """End the mission: crane and machine come to rest, and the planner ends."""
    _order("ABORT", profile, order_port, key_file)


def _orders(profile: str, order_port: int, key_file: Path | None) -> tuple[Profile, PlannerOrders]:
    from machine.loading.profile_file import load_profile, profile_hash
    from timberhand.mission_orders import PlannerOrders, key_of

    machine = load_profile(profile)
    return machine, PlannerOrders(order_port, profile_hash(machine), key_of(key_file))


def _order(action: str, profile: str, order_port: int, key_file: Path | None) -> None:
    from can_dbc.messages.mission import MissionAction

    _, orders = _orders(profile, order_port, key_file)
    report = orders.order(MissionAction[action])
    print(f"{report.name}: {report.words}")


@app.command()
def states(
    docs: Annotated[Path | None, typer.Option(help="Write the page activity.md into this folder instead.")] = None,
) -> None:
    """Print the activity manager's transition tables with state charts: paper B's (Fig. 8) and our own.

    [bold]Examples[/bold]

      timberhand mission states --docs docs
    """
    from autonomy.manager.state_chart import page

    if docs is None:
        print(page())
        return
    path = docs / "activity.md"
    try:
        path.write_text(page())
    except OSError as error:
        raise CommandFailed(
            "mission.page-not-written", f"{path} cannot be written ({error.strerror}); name a folder with --docs"
        ) from None
    print(f"written: {path}")
