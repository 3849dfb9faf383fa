"""``timberhand calibrate``: identify the properties of a machine, and write its profile."""

from __future__ import annotations

import json
import math
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.exit_codes import CommandFailed, ExitCode
from runtime.errors import ConfigError, InputRefused, LinkError
from timberhand.commands.options import refuse_without_effect, truth_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from rich.console import Console

    from autonomy.calibration.live import Surveyor
    from autonomy.calibration.plan import CalibrationPlan
    from autonomy.calibration.procedure import Calibration
    from machine.joints import Joint
    from machine.profile import Profile


def calibrate(
    context: typer.Context,
    profile: Annotated[str, typer.Option(help="Present machine profile: a shipped name or a TOML file.")],
    out: Annotated[Path, typer.Option(help="New TOML file: the calibrated profile.")] = Path("calibrated.toml"),
    report: Annotated[Path | None, typer.Option(help="Folder of the report (default: beside --out).")] = None,
    survey: Annotated[
        str | None, typer.Option(help="HOST:PORT of a total station, or 'ask' to type its readings.")
    ] = None,
    joint: Annotated[
        list[str] | None, typer.Option(help="Test this joint only, after its valve was replaced; may be repeated.")
    ] = None,
    controller: Annotated[str, typer.Option(help="HOST:PORT of the controller's setpoint port.")] = "127.0.0.1:47001",
    report_port: Annotated[int, typer.Option(min=0, max=65535, help="Local UDP port for the state reports.")] = 47002,
    bus: Annotated[str, typer.Option(help="Bus of the crane, as in socketcan:can0; read only.")] = "wire:crane0",
    key_file: Annotated[Path | None, typer.Option(help="File with the key that authenticates datagrams.")] = None,
    lease_ms: Annotated[int, typer.Option(help="Lease of a setpoint in ms.")] = 200,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation before the machine moves.")] = False,
    lockstep: Annotated[bool, typer.Option(help="Calibrate a virtual machine in virtual time.")] = False,
    truth: Annotated[
        str, typer.Option(help="With --lockstep: ground truth: nominal, sampled, wide_valves, or a TOML file.")
    ] = "sampled",
    seed: Annotated[int, typer.Option(help="With --lockstep: chooses the virtual machine.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report's result.json on stdout.")] = False,
) -> None:
    """Identify dead-bands, gains, delays, zeros and sag of a machine over its bus, and write a new profile.

    The crane moves for about four minutes, one function at a time. Ctrl-C stops
    it at any time. A profile is written only when every value is plausible;
    otherwise the exit code is 6 and the report tells why.

    [bold]Examples[/bold]

      timberhand calibrate --profile palms_471 --lockstep --survey sim

      timberhand calibrate --profile palms_471 --bus socketcan:crane0 --survey ask
      --controller 127.0.0.1:24701 --report-port 24702 --key-file /etc/timberhand/key

      the same with --joint lift      under a minute
    """
    from rich.console import Console

    from autonomy.calibration.profile_file import lowered_gains, profile_changes, write_profile
    from autonomy.calibration.report import result_document, write_report
    from autonomy.calibration.result import identify
    from machine.loading.profile_file import carry_envelope, load_profile

    if lockstep:
        live_only = ("controller", "report_port", "bus", "key_file", "lease_ms")
        refuse_without_effect(context, live_only, "with --lockstep")
    else:
        refuse_without_effect(context, ("truth", "seed"), "without --lockstep")
    known = load_profile(profile)
    if out.exists():
        raise CommandFailed(
            "calibrate.output-exists", f"{out} exists and is not overwritten; choose another --out", ExitCode.USAGE
        )
    if out.suffix != ".toml":
        raise CommandFailed(
            "calibrate.output-name", f"{out} has no name of a profile; call it {out.name}.toml", ExitCode.USAGE
        )
    if find_spec("matplotlib") is None:
        raise CommandFailed(
            "calibrate.no-matplotlib", "the report needs matplotlib, so nothing moves: pip install 'timberhand[tools]'"
        )
    folder, chosen = report or out.with_suffix(""), _chosen(joint)
    try:
        for needed in (out.parent, folder):
            needed.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CommandFailed(
            "calibrate.no-folder", f"{needed} cannot be made: {error.strerror}; choose another --out or --report"
        ) from None
    screen = Console(stderr=True)
    if lockstep:
        truth = truth_of(profile, truth)
        calibration = _lockstep(profile, known, truth, seed, survey is not None, chosen, folder, screen)
    else:
        calibration = _live(
            known,
            (controller, report_port, bus, key_file, lease_ms),
            survey,
            chosen,
            lambda plan: _confirm(known, plan, yes),
            screen,
        )
    with screen.status("fitting"):
        result = identify(known, calibration.found)
    changed = profile_changes(known, result)
    facts: dict[str, Any] = {"profile": known.name, "date": _today(), "seconds": calibration.elapsed_s}
    facts["repeated_tests"] = calibration.resumptions
    facts |= {"lockstep": {"truth": truth, "seed": seed}} if lockstep else {}
    reported, gap = f"report in {folder}", ""
    try:
        write_report(folder, result, facts, changed)
    except (OSError, ImportError) as error:  # the profile is worth more than its pictures
        reported = gap = f"the report in {folder} is not whole ({error})"
    if as_json:
        print(json.dumps(result_document(result, facts, changed), indent=2))
    _show(result, screen)
    if result.implausible:
        screen.print("\n".join(f"[red]✘[/red] {problem.sentence}" for problem in result.implausible), highlight=False)
        raise CommandFailed(
            "calibrate.implausible",
            f"no profile is written: {len(result.implausible)} values are implausible; {reported}",
            ExitCode.FIGURE_MISSED,
        )
    try:
        write_profile(_source(profile), out, changed, facts["date"])
        carry_envelope(_source(profile), out.parent)
    except InputRefused as error:
        raise CommandFailed.from_error(error, ExitCode.FIGURE_MISSED) from None
    screen.print(f"[green]✔[/green] {out} written, {len(changed)} values; {reported}", highlight=False)
    if calibration.resumptions:
        screen.print(f"tests repeated after a stop: {calibration.resumptions}", highlight=False)
    if result.survey is None:
        screen.print("zeros and sag are unchanged, because nothing was surveyed (--survey)", highlight=False)
    for sentence in (*lowered_gains(changed), *result.kept):
        screen.print(sentence, highlight=False)
    if gap:
        raise CommandFailed(
            "calibrate.report-not-written", f"{out} is written, but {gap}; read the new values there, marked [cal]"
        )


def _chosen(names: Sequence[str] | None) -> tuple[Joint, ...]:
    """Return the named joints, or all."""
    from machine.joints import JOINTS, Joint

    try:
        return tuple(Joint[name.upper()] for name in names) if names else tuple(JOINTS)
    except KeyError as error:
        known = ", ".join(j.name.lower() for j in JOINTS)
        raise CommandFailed(
            "calibrate.joint", f"--joint {error.args[0].lower()}: there are {known}", ExitCode.USAGE
        ) from None


def _today() -> str:
    import datetime

    return datetime.date.today().isoformat()


def _source(profile: str) -> Path:
    from controller.guard.__main__ import profile_path

    return Path(profile_path(profile))


def _confirm(profile: Profile, plan: CalibrationPlan, yes: bool) -> None:
    """Show the motions and ask for confirmation; raises CommandFailed without one."""
    from autonomy.calibration.plan import plan_summary

    print(f"{profile.title}: these functions will move, one at a time:", file=sys.stderr)
    for line in plan_summary(profile, plan):
        print(f"  {line}", file=sys.stderr)
    print("Clear the zone: no person and no log within reach, the grapple empty, the machine at rest.", file=sys.stderr)
    if not yes and not typer.confirm("Move now?", err=True):
        raise CommandFailed("calibrate.not-confirmed", "nothing was moved", ExitCode.INTERRUPTED)


def _lockstep(
    name: str,
    profile: Profile,
    truth: str,
    seed: int,
    surveyed: bool,
    chosen: Collection[Joint],
    folder: Path,
    screen: Console,
) -> Calibration:
    from hil.calibration import run_lockstep
    from recorder.manifest import describe
    from recorder.recorder import Recorder

    interrupts: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
    recorder = None
    try:
        buses = tuple(bus for bus in (profile.crane_bus, profile.machine_bus) if bus)
        recorder = Recorder(folder / "log", profile, describe(profile, buses, seed))
        with _Progress(screen) as progress:
            outcome = run_lockstep(
                name,
                truth,
                seed,
                surveyed=surveyed,
                chosen=chosen,
                recorder=recorder,
                show=lambda plan: _confirm(profile, plan, yes=True),
                watch=progress.show,
                aborted=lambda: bool(interrupts),
            )
    except ValueError as error:
        raise CommandFailed.from_error(error) from None
    finally:
        signal.signal(signal.SIGINT, before)
        if recorder is not None:
            recorder.close()
    if interrupts:
        raise CommandFailed(
            "calibrate.interrupted", "interrupted; the valves are neutral, no profile is written", ExitCode.INTERRUPTED
        )
    if outcome.failure is not None or outcome.calibration is None:
        raise CommandFailed(
            "calibrate.ended-early",
            f"calibration ended: {outcome.failure}; no profile is written",
            ExitCode.SAFETY_STOP,
        )
    return outcome.calibration


def _live(
    profile: Profile,
    link_options: tuple[str, int, str, Path | None, int],
    survey: str | None,
    chosen: Collection[Joint],
    confirm: Callable[[CalibrationPlan], None],
    screen: Console,
) -> Calibration:
    from autonomy.calibration import live
    from autonomy.calibration.plan import make_plan
    from autonomy.calibration.procedure import Calibration
    from autonomy.calibration.procedure_state import PATIENCE_S, READING_COUNT
    from autonomy.process.controller_link import ControllerLink
    from can_dbc.bus.factory import open_bus
    from can_dbc.dbc.codec import load
    from can_dbc.messages.envelope import read_key
    from can_dbc.messages.udp_address import udp_address
    from machine.loading.profile_file import profile_hash
    from machine.status.modes import Mode

    controller, report_port, address, key_file, lease_ms = link_options
    if not 0 < lease_ms <= profile.timeouts.lease_max_ms:
        raise CommandFailed(
            "calibrate.lease",
            f"--lease-ms {lease_ms}: {profile.name} allows 1..{profile.timeouts.lease_max_ms}",
            ExitCode.USAGE,
        )
    interrupts: list[int] = []
    try:
        where = udp_address(controller)
        reader = _surveyor(survey, screen, interrupts)
        key = None if key_file is None else read_key(key_file)
        link = ControllerLink(where, report_port, profile_hash(profile), key)
    except ConfigError as error:
        raise CommandFailed.from_error(error, ExitCode.CONFIGURATION) from None
    except ValueError as error:
        raise CommandFailed.from_error(error, ExitCode.USAGE) from None
    except OSError as error:
        raise CommandFailed(
            "calibrate.port", f"UDP port {report_port}: {error}; choose another one", ExitCode.BUS
        ) from None
    try:
        report = live.first_report(link, 10.0, (Mode.STANDBY, Mode.ARMED, Mode.STOP))
        if link.foreign:
            raise CommandFailed(
                "calibrate.other-profile", "the controller runs another profile: start both with the same one"
            )
        if report is None:
            raise CommandFailed(
                "calibrate.no-controller",
                f"no controller in STANDBY reports on port {report_port} within 10 s; start one with "
                f"--report 127.0.0.1:{report_port}, and give both the same --key-file",
                ExitCode.BUS,
            )
        plan = make_plan(profile, report.position, survey is not None, chosen)
        confirm(plan)
        readings = 1 if survey == "ask" else READING_COUNT
        lease_ns = lease_ms * 1_000_000
        run = Calibration(
            profile, profile_hash(profile), plan, load("crane"), lease_ns, key, readings, patience_s=PATIENCE_S
        )
        before = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number))
        try:
            with (
                open_bus(address, filters=run.trace.keys, participant="calibrate") as bus_frames,
                _Progress(screen) as shown,
            ):

                def watch(calibration: Calibration) -> None:
                    if interrupts:
                        calibration.abort("interrupted")
                        calibration.idle = calibration.idle or calibration.waiting is not None
                    shown.show(calibration)

                live.run(run, link, bus_frames, reader, watch)
        finally:
            signal.signal(signal.SIGINT, before)
    except LinkError as error:
        raise CommandFailed.from_error(error, ExitCode.BUS) from None
    finally:
        link.close()
    if interrupts:
        raise CommandFailed(
            "calibrate.interrupted", "interrupted; the valves are neutral, no profile is written", ExitCode.INTERRUPTED
        )
    if not run.done:
        raise CommandFailed(
            "calibrate.ended-early", f"calibration ended: {run.failure}; no profile is written", ExitCode.SAFETY_STOP
        )
    return run


def _surveyor(survey: str | None, screen: Console, interrupts: list[int]) -> Surveyor | None:
    """Make the source of survey readings: none, typed, or an instrument."""
    from autonomy.calibration.live import SurveyInstrument
    from can_dbc.messages.udp_address import udp_address

    if survey is None:
        return None
    return _Typed(screen, interrupts) if survey == "ask" else SurveyInstrument(udp_address(survey))


class _Typed:
    """Survey readings that a person types.

    The crane stands still and its last setpoint was final, so the lease may expire meanwhile.
    """

    def __init__(self, screen: Console, interrupts: list[int]) -> None:
        self._screen, self._interrupts = screen, interrupts

    def _ask(self, question: str) -> str | None:
        """Ask; None after Ctrl-C or the end of the input, which join the run's interrupts."""
        if self._interrupts:
            return None  # the run comes to rest
        try:
            before = signal.signal(signal.SIGINT, signal.default_int_handler)  # the run's own lets a prompt wait on
            try:
                return str(typer.prompt(question, err=True))
            finally:
                signal.signal(signal.SIGINT, before)
        except (KeyboardInterrupt, typer.Abort):
            self._interrupts.append(signal.SIGINT)
            return None

    def read(self, now_ns: int) -> tuple[float, float, float] | None:
        """Ask for the position of the hanger pin [m]; None after invalid input."""
        if (text := self._ask("hanger pin x y z [m, crane base frame]")) is None:
            return None
        try:
            x, y, z = map(float, text.replace(",", " ").split())
        except ValueError:
            self._screen.print("enter three numbers, as in 0.12 5.43 2.10")
            return None
        return x, y, z

    def read_yaw(self, now_ns: int) -> float | None:
        """Ask for the direction of the grapple [rad]; NaN when nobody can read it, None after invalid input."""
        text = self._ask("direction along which the grapple opens [deg from x towards y, - for none]")
        if text is None:
            return None
        try:
            return math.nan if text.strip() == "-" else math.radians(float(text))
        except ValueError:
            self._screen.print("enter degrees, as in 92.5, or - if it cannot be read; then the rotator is not tested")
            return None


class _Progress:
    """A progress bar with the remaining time and the present task."""

    def __init__(self, screen: Console) -> None:
        from rich.progress import BarColumn, Progress, TextColumn

        columns = (TextColumn("{task.description:<34}"), BarColumn(), TextColumn("{task.fields[left]:>3.0f} s left"))
        self._bar = Progress(*columns, console=screen, transient=True)
        self._task = self._bar.add_task("waiting", total=1.0, left=0.0)
        self._waiting: str | None = None
        self._screen = screen

    def __enter__(self) -> _Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, calibration: Calibration) -> None:
        """Show the present state of the run."""
        from autonomy.calibration.plan import task_name

        remaining_s = calibration.remaining_s()
        if calibration.waiting != self._waiting:
            self._waiting = calibration.waiting
            if self._waiting is not None:
                self._screen.print(f"waiting for ARM: {self._waiting}", highlight=False)
        whole = max(calibration.elapsed_s + remaining_s, 1.0)
        self._bar.update(
            self._task,
            completed=calibration.elapsed_s / whole,
            description=task_name(calibration.task),
            left=remaining_s,
        )


def _show(result: Any, screen: Console) -> None:
    """Print the values as a table."""
    from rich.table import Table

    table = Table("joint", "dead-band + / - [%]", "full speed + / -", "dead time [ms]", "lag [ms]", "response [ms]")
    for j, r in result.joints.items():
        delay = ("-", "-") if r.delay is None else (f"{1e3 * r.delay.delay_s:.0f}", f"{1e3 * r.delay.lag_s:.0f}")
        table.add_row(
            j.name.lower(),
            " / ".join(f"{100 * d:.1f}" for d in r.valve.deadbands),
            " / ".join(f"{f:.3f}" for f in r.valve.full_speeds),
            *delay,
            " / ".join(f"{1e3 * s:.0f}" for s in r.responses_s),
        )
    if (turns := result.turns) is not None:
        sides = (turns.plus, turns.minus)
        deadbands = " / ".join(f"{100 * s.deadband:.1f}" for s in sides)
        table.add_row("rot", deadbands, " / ".join(f"{s.full_speed:.3f}" for s in sides), "-", "-", "-")
    screen.print(table)
    if result.survey is not None:
        before, after = (1e3 * max(d) for d in (result.survey.before_m, result.survey.after_m))
        screen.print(f"survey: largest pin error {before:.0f} mm as shipped, {after:.0f} mm with zeros and sag")
