"""``timberhand bench``: benchmarks that print their environment and their figures."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands import bench_codec, bench_tick
from timberhand.commands.options import JsonOption, ProfileOption, TruthOption, truth_of

# -- ``timberhand bench bus``: the cost of receiving a frame, compared with python-can in one run.


def bus(
    frames: Annotated[int, typer.Option(min=10, help="Frames per round and receive path.")] = 1000,
    rounds: Annotated[int, typer.Option(min=3, help="Rounds with all paths in turn; the median counts.")] = 31,
    as_json: JsonOption = False,
) -> None:
    """Measure the time from the socket to checked and decoded values, per frame of crane0, for every receive path.

    Uses vcan where the kernel has it, else a socket pair with the same code on
    top. Exit code 6 when the fast path needs more than 5 us per frame; not
    evaluated inside user-mode Linux.

    [bold]Examples[/bold]

      timberhand bench bus

      timberhand hil vcan -- timberhand bench bus --rounds 5
    """
    from experiments.common.result import environment
    from experiments.timing.receive_cost import LIMIT_US, measure

    result = {"environment": environment()} | measure(frames, rounds)
    metrics, lab = result["metrics"], result["lab"]
    reached = metrics["rx_decode_us"] <= LIMIT_US
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        _show_bus(result, reached)
    if not reached and not lab:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _show_bus(result: dict[str, Any], reached: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    screen = Console(soft_wrap=True, highlight=False)
    metrics = result["metrics"]
    screen.print("  ".join(f"[dim]{name}[/dim] {value}" for name, value in result["environment"].items()))
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("path")
    for column in ("receive µs", "+ check and decode µs"):
        table.add_column(column, justify="right")
    for name, label in result["paths"].items():
        suffix = "" if name == "ours" else f"_{name}"
        table.add_row(label, f"{metrics[f'rx{suffix}_us']:.2f}", f"{metrics[f'rx_decode{suffix}_us']:.2f}")
    screen.print(table)
    if "pair" in result["paths"]["ours"]:
        screen.print("[dim]This kernel has no CAN: a pair of datagram sockets carries the frames instead.[/dim]")
    screen.print(f"python-can costs {metrics['rx_decode_ratio']:.1f} times as much")
    if result["lab"]:
        screen.print("[yellow]lab: user-mode Linux, where a system call costs a hundred times as much[/yellow]")
    else:
        mark = "[green]✔[/green]" if reached else "[red]✘[/red]"
        screen.print(f"{mark} at most {result['limit_us']:.0f} µs per frame, received and decoded")
    screen.print(f"[dim]{result['rounds']} rounds of {result['frames']} frames, {result['clock']}[/dim]")


# -- ``timberhand bench plant``: real-time factor of the plant on this host.


def plant(
    profile: ProfileOption = "palms_471",
    truth: TruthOption = "nominal",
    quick: Annotated[bool, typer.Option(help="Fewer repetitions.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure the real-time factors of a crane with 12 logs and of a whole mission, camera time and cost per log.

    Exit code 6 when a factor is missed on a quiet host; on a noisy host the
    figure is reported as inconclusive.
    """
    from rich.console import Console
    from rich.table import Table

    from experiments.common.result import environment, evaluate
    from experiments.plant.bench import LOG_COUNTS, METRICS, measure

    screen = Console(stderr=as_json, highlight=False, soft_wrap=True)
    metrics, noisy, _ = measure(profile, truth_of(profile, truth), quick, screen)
    missed, inconclusive = evaluate(METRICS, metrics, noisy)
    if as_json:
        verdict = {"missed": missed, "inconclusive": inconclusive, "noisy": noisy}
        typer.echo(json.dumps({"environment": environment(), "metrics": metrics, **verdict}, indent=2))
    else:
        screen.print("  ".join(f"[dim]{name}[/dim] {value}" for name, value in environment().items()))
        for f in METRICS:
            word = "inconclusive" if f.name in inconclusive else "missed" if f.name in missed else "reached"
            ratio = metrics[f.name.replace("_ms", "") + "_per_reference"]
            screen.print(f"{f.title}: [bold]{f.text(metrics[f.name])}[/bold] ({f.limit_text()}: {word})")
            screen.print(f"  [dim]{ratio:.2f} times the fixed work measured beside it[/dim]")
        table = Table(box=None, header_style="bold", pad_edge=False)
        for count in LOG_COUNTS:
            table.add_column(f"{count} logs", justify="right")
        table.add_row(*(f"{metrics[f'step_ms_{count}_logs']:.3f} ms" for count in LOG_COUNTS))
        screen.print("physics step of 2.5 ms with logs on the ground")
        screen.print(table)
        screen.print(
            f"[dim]host: {100 * metrics['host_stolen']:.0f} % of the time taken away, fixed work unequal by "
            f"{100 * metrics['host_unequal']:.0f} %{': noisy' if noisy else ''}[/dim]"
        )
    if missed:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


# -- ``timberhand bench motion``: planning time and duration of collision-free crane motions.


def motion(
    seeds: Annotated[int, typer.Option(min=1, help="Scenes of each kind.")] = 6,
    profile: Annotated[
        list[str] | None, typer.Option(help="Machine profile; may be repeated (default: both shipped ones).")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Plan the motions of a crane cycle in simulated scenes; compare them with motions at full travel height.

    [bold]Examples[/bold]

      timberhand bench motion

      timberhand bench motion --profile aoro_fc8 --seeds 20 --json
    """
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from experiments.benches.motion import GOAL_MS, run
    from machine.loading.profile_file import load_profile

    error = Console(stderr=True)
    metrics_by_machine = {}
    for name in profile or ["palms_471", "aoro_fc8"]:
        try:
            machine = load_profile(name)
            with Progress(console=error, transient=True, disable=not error.is_terminal) as bar:
                task = bar.add_task(name, total=None)

                def progress(done: int, total: int, bar: Progress = bar, task: TaskID = task) -> None:
                    bar.update(task, completed=done, total=total)

                bench = run(machine, seeds, progress)
        except ValueError as trouble:
            raise CommandFailed.from_error(trouble) from None
        metrics_by_machine[name] = bench.metrics()
        if not as_json:
            m = bench.metrics()
            typer.echo(
                f"{name}: {m['motions']} motions, {m['blocked']} blocked, {m['no_grasp']} scenes without a grasp\n"
                f"  planned in {m['cpu_p50_ms']:.0f} ms of CPU (median), {m['cpu_p95_ms']:.0f} ms (95 %); "
                f"best of 4: {m['cpu_best_p50_ms']:.0f} and {m['cpu_best_p95_ms']:.0f} ms (goal: {GOAL_MS:.0f} ms)\n"
                f"  duration {m['ours_mean_s']:.2f} s (mean); at full travel height {m['travel_mean_s']:.2f} s, "
                f"with {m['travel_too_near']} clearance violations"
            )
            for sentence in bench.blocked[:5]:
                typer.echo(f"  {sentence}")
    if as_json:
        typer.echo(json.dumps(metrics_by_machine, indent=2))


# -- ``timberhand bench loop-design``: stability margins of every loop over the whole spread of machines.


def loop_design(
    profile: Annotated[
        list[str] | None, typer.Option(help="Machine profile; may be repeated (default: both shipped ones).")
    ] = None,
    truth: Annotated[
        str, typer.Option(help="Ground truth of the plant and its spread: nominal or a TOML file.")
    ] = "nominal",
    out: Annotated[Path | None, typer.Option(help="Folder for plots (default: none).")] = None,
    docs: Annotated[
        Path | None, typer.Option(help="Folder of the page loop-design.md, written again with plots.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute phase margin, gain margin and bandwidth of every control loop, for the worst machine.

    Linear models of every joint and of the carrier with their control laws, over
    near, working and far reach, empty and loaded, and the whole spread of dead
    times and gains; of the heading loop slow and fast, near a waypoint and far
    from it. Exit code 6 when a phase margin is below 40 deg or a gain margin
    below 6 dB.

    [bold]Examples[/bold]

      timberhand bench loop-design

      timberhand bench loop-design --profile my.toml --out runs/loops

      timberhand bench loop-design --docs docs
    """
    from rich.console import Console
    from rich.table import Table

    from experiments.loop_design import carrier
    from experiments.loop_design.study import MIN_GAIN_DB, MIN_PHASE_DEG, case_set, study
    from machine.loading.profile_file import load_profile

    screen = Console(stderr=as_json, highlight=False, soft_wrap=True)
    documents: dict[str, Any] = {}
    machines = []
    holds = True
    for source in profile or ["palms_471", "aoro_fc8"]:
        try:
            machine = load_profile(source)
            with screen.status(f"{machine.name}: margins over all machines"):
                work = case_set(source, truth)
                studies = study(machine, work) + carrier.studies(machine, work)
        except ValueError as error:
            raise CommandFailed.from_error(error) from None
        table = Table(box=None, header_style="bold", pad_edge=False, title=machine.title, title_justify="left")
        for column in ("joint", "law", "kp 1/s", "phase deg", "gain dB", "bandwidth Hz", "worst machine"):
            table.add_column(column, justify="left" if column in ("joint", "law", "worst machine") else "right")
        for joint in studies:
            mark = "[green]✔[/green]" if joint.holds else "[red]✘[/red]"
            law = joint.spec.law
            table.add_row(
                f"{mark} {joint.name}",
                law.kind,
                f"{law.kp_1_s:g}",
                f"{joint.phase_deg:.0f}",
                f"{joint.gain_db:.1f}",
                f"{joint.bandwidth_hz:.2f}",
                str(joint.worst),
            )
            holds = holds and joint.holds
        screen.print(table)
        machines.append((machine, studies, work))
        documents[machine.name] = {joint.name: joint.document() for joint in studies}
        if out is not None:
            from experiments.loop_design.page import draw

            for file in draw(machine.name, studies, out):
                screen.print(f"[dim]{file}[/dim]")
    if docs is not None:
        from experiments.loop_design.page import write

        with screen.status("every law"):
            holds = write(machines, docs) and holds
        screen.print(f"[dim]{docs / 'loop-design.md'}[/dim]")
    needed = {"phase_deg": MIN_PHASE_DEG, "gain_db": MIN_GAIN_DB}
    if as_json:
        typer.echo(json.dumps({"needed": needed, "reached": holds, "machines": documents}, indent=2))
    else:
        screen.print(f"needed everywhere: {MIN_PHASE_DEG:.0f} deg and {MIN_GAIN_DB:.0f} dB")
    if not holds:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


# -- ``timberhand bench pages``: what a tick does without and with open pages of the console.

COUNTS: Final = {
    "calls": "system calls of a tick",
    "frames": "frames sent by a tick",
    "instructions": "instructions of a tick",
}


def pages(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of both sides; fewer than 6 decide no time.")] = 7,
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of a window; each has two.")] = 4.0,
    number: Annotated[int, typer.Option("--pages", min=1, max=32, help="Open pages of the other side.")] = 10,
    as_json: JsonOption = False,
) -> None:
    """Count what a tick does while no page and while ten pages are open, in turn, in one run.

    Controller, guard, emulated machine and console run as processes on the
    wire. System calls, frames and, where the host counts them, instructions of
    a tick are counts, which no other load changes; with pages they must be the
    same to 2 %. Processor time is the median ratio over the rounds with its
    95 % interval; "inconclusive" when the interval holds the limit, as on a
    loud host. Exit code 6 when a count differs or the ratio is missed.

    [bold]Examples[/bold]

      timberhand bench pages

      timberhand bench pages --rounds 9 --pages 20 --json
    """
    import tempfile

    from experiments.common import host_activity
    from experiments.common.result import environment
    from experiments.timing import open_pages

    def progress(text: str) -> None:
        print(f"bench: {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder:
        judgement = open_pages.judge(open_pages.measure(rounds, seconds, number, Path(folder), progress))
    where = environment() | host_activity.describe()
    if as_json:
        print(json.dumps({"environment": where, "pages": number, **judgement}, indent=2))
    else:
        print("  ".join(f"{name} {value}" for name, value in where.items()))
        _show_pages(judgement, number)
    if not judgement["reached"]:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


def _show_pages(found: dict[str, Any], number: int) -> None:
    print(f"{'':28}{'no page':>12}{f'{number} pages':>12}")
    for name, title in COUNTS.items():
        count = found["counts"][name]
        if count["same"] is None:
            print(f"{title:28}{'not counted here':>24}")
        else:
            print(f"{title:28}{count['none']:12g}{count['open']:12g}   {'the same' if count['same'] else 'differs'}")
    cpu = found["cpu"]
    too_few = cpu["high"] is None
    interval = "fewer than 6 rounds give no interval" if too_few else f"{cpu['low']:.2f} to {cpu['high']:.2f}"
    print(
        f"{'processor time of a tick, us':28}{cpu['none']:12g}{cpu['open']:12g}   "
        f"ratio {cpu['ratio']:.2f} ({interval}), at least {cpu['at_least']}: {cpu['verdict']}"
    )
    print(
        f"{'ticks missed':28}{found['missed']['none']:12}{found['missed']['open']:12}   "
        f"of {found['ticks']['none']} and {found['ticks']['open']}"
    )
    print(f"the pages got {found['states']} states meanwhile")


app = typer.Typer(no_args_is_help=True, help="Benchmarks: measure the documented figures again.")
app.command("bus")(bus)
app.command("codec")(bench_codec.codec)
app.command("loop-design")(loop_design)
app.command("pages")(pages)
app.command("plant")(plant)
app.command("motion")(motion)
app.command("tick")(bench_tick.tick)


@app.command()
def pool(as_json: JsonOption = False) -> None:
    """Measure the overhead of a trial, and how two workers scale: trials that only wait.

    [bold]Examples[/bold]

      timberhand bench pool
    """
    from rich.console import Console

    from experiments.benches.pool import TRIALS, WAIT_S, measure

    runs = [measure(count, Console(stderr=True)) for count in (1, 2)]
    if as_json:
        print(json.dumps([asdict(run) for run in runs]))
        return
    for run in runs:
        print(
            f"{run.workers} worker{'s' if run.workers > 1 else ''}: {TRIALS} trials of {WAIT_S:g} s in "
            f"{run.wall_s:.2f} s, {1e3 * run.between_s:.1f} ms between two, {run.peak_bytes / 2**20:.0f} MiB each"
        )
    print(f"two are {runs[0].wall_s / runs[1].wall_s:.2f} times as fast as one")
