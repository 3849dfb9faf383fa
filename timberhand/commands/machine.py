"""``timberhand machine``: draft the files of a machine of one's own, and check them."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import JsonOption, refuse_without_effect

if TYPE_CHECKING:
    from timberhand.machine_files import Finding

app = typer.Typer(no_args_is_help=True, help="Make and check the files of a machine of your own.")


@app.command()
def questions() -> None:
    """Print the questionnaire as a file of answers, filled in with an example.

    The example is a truck-mounted timber loader. Change its answers to your
    machine's and give the file to `timberhand machine new`.

    [bold]Examples[/bold]

      timberhand machine questions > answers.toml
    """
    from machine.draft.questions import answers_text, example

    print(answers_text(example()), end="")


@app.command()
def new(
    context: typer.Context,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder for the files; it is made.")],
    answers: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Answers as TOML; without, and on a terminal, you are asked.")
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="URDF of the crane: its geometry and ranges, where the answers have none."),
    ] = None,
    urdf_joints: Annotated[
        str,
        typer.Option(metavar="OURS=THEIRS,...", help="Joints of the URDF: slew, lift, tilt, ext, hanger, rot."),
    ] = "",
) -> None:
    """Draft profile, envelope, truth and URDF of a machine from a questionnaire.

    The envelope has no seal: check every limit in it, then seal it with
    `python -m controller.guard.seal FILE`.

    [bold]Examples[/bold]

      timberhand machine new my_loader --answers answers.toml

      timberhand machine new my_loader --answers rest.toml --urdf crane.urdf --urdf-joints slew=joint1,lift=joint2

      timberhand machine new my_loader           asks on the terminal
    """
    from machine.draft.answers import read_answers
    from machine.draft.from_urdf import answers_from_urdf
    from machine.draft.questions import merged
    from timberhand.machine_files import check as check_files
    from timberhand.machine_files import make

    if urdf is None:
        refuse_without_effect(context, ("urdf_joints",), "without --urdf")
    described = {} if urdf is None else answers_from_urdf(urdf, _names(urdf_joints))
    if answers is not None:
        given = read_answers(answers)
    elif sys.stdin.isatty():
        given = _ask(described)
    else:
        raise CommandFailed(
            "machine.no-answers",
            "there is no terminal to ask on; give --answers FILE, from `timberhand machine questions`",
            ExitCode.USAGE,
        )
    path = make(merged(given, described), str(answers or folder), folder)
    findings = [finding for finding in check_files(str(path)) if finding.code != "guard.envelope-damaged"]
    _show(str(path), findings)
    envelope = path.with_name(f"{path.stem}.envelope.toml")
    print(f"next: check every limit in {envelope}, then run: python -m controller.guard.seal {envelope}")
    if any(not finding.note for finding in findings):
        raise typer.Exit(ExitCode.CONFIGURATION)


@app.command()
def check(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="A shipped name or a TOML file.")],
    as_json: JsonOption = False,
) -> None:
    """Say what is missing or contradictory in a machine's files.

    The profile is built into a controller, the envelope into a guard, and both are
    compared with the truth and the URDF beside the profile. Exit code 3 when
    something is wrong; a note is no error.

    [bold]Examples[/bold]

      timberhand machine check my_loader/my_loader.toml

      timberhand machine check palms_471 --json
    """
    from timberhand.machine_files import check as check_files

    findings = check_files(profile)
    if as_json:
        print(json.dumps({"profile": profile, "findings": [asdict(finding) for finding in findings]}, indent=2))
    else:
        _show(profile, findings)
    if any(not finding.note for finding in findings):
        raise typer.Exit(ExitCode.CONFIGURATION)


def _show(profile: str, found: list[Finding]) -> None:
    for finding in found:
        prefix = "" if finding.sentence.startswith(finding.file) else f"{finding.file}: "
        print(f"{'note: ' if finding.note else ''}{prefix}{finding.sentence} [{finding.code}]")
    wrong = sum(not finding.note for finding in found)
    print(f"{profile}: {'no problem' if not wrong else f'{wrong} problem' + 's' * (wrong > 1)}")


def _names(text: str) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in text.split(",") if pair]
    known = ("slew", "lift", "tilt", "ext", "hanger", "rot", "fork", "tong_left")
    for own_name, equals, theirs in pairs:
        if not equals or not theirs or own_name not in known:
            raise CommandFailed(
                "machine.urdf-joints",
                f"--urdf-joints {text}: write OURS=THEIRS with one of {', '.join(known)}, as in slew=joint1",
                ExitCode.USAGE,
            )
    return {own_name: theirs for own_name, _, theirs in pairs}


def _ask(described: dict[str, Any]) -> dict[str, Any]:
    """Ask every question that the URDF does not answer; Enter takes the example's answer."""
    from machine.draft.questions import NONE, example, put
    from machine.draft.questions import questions as all_questions

    print(f"SI units: m, rad, s, kg, Pa. Enter takes the answer in brackets; {NONE} means that it does not apply.")
    raw: dict[str, Any] = {}
    for question in all_questions(example()):
        table = described
        for key in question.path:
            table = table.get(key) if isinstance(table, dict) else None  # type: ignore[assignment]
        if table is None:
            put(raw, question.path, _answer(question))
    return raw


def _answer(question: Any) -> Any:
    from machine.draft.questions import NONE
    from machine.draft.toml_text import value_text

    shown = NONE if question.proposal is None else value_text(question.proposal)
    while True:
        typed = typer.prompt(f"{'.'.join(question.path)}: {question.text}", default=shown)
        try:
            return question.parse(typed)
        except ValueError as error:
            print(f"  {error}; write {shown} for example", file=sys.stderr)
