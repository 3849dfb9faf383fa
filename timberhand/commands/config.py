"""``timberhand config``: check, show, compare and migrate the settings of the services and the machine's files."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from host.exit_codes import CommandFailed, ExitCode
from timberhand.commands.options import JsonOption

app = typer.Typer(no_args_is_help=True, help="Check, show, compare and migrate settings and machine files.")

File = Annotated[
    Path | None, typer.Argument(metavar="FILE", help="Settings file (default: /etc/timberhand/timberhand.conf).")
]


@app.command()
def check(file: File = None, as_json: JsonOption = False) -> None:
    """Check settings against this release, the machine's profile and its envelope, and what is signed by its signature.

    Exit code 3 when something is wrong; each problem names its line. What is
    only missing is as this release ships it, and is a note.

    [bold]Examples[/bold]

      timberhand config check

      timberhand config check deploy/timberhand.conf --json
    """
    from host.release.updater import SIGNER
    from timberhand.configuration.check import problems_of, signature_problems
    from timberhand.configuration.settings_file import INSTALLED, SHIPPED, read

    path = file or INSTALLED
    problems = [*problems_of(read(path), read(SHIPPED)), *signature_problems(path, SIGNER)]
    if as_json:
        problem_rows = [asdict(problem) for problem in problems]
        print(json.dumps({"file": str(path), "problems": problem_rows}, indent=2))
    else:
        for problem in problems:
            print(f"{path}{f':{problem.line}' if problem.line else ''}: {problem.sentence}")
        if not problems:
            print(f"{path}: no problem")
    if any(not problem.note for problem in problems):
        raise typer.Exit(ExitCode.CONFIGURATION)


@app.command()
def show(file: File = None, as_json: JsonOption = False) -> None:
    """Show the settings in force and the SHA-256 of every file that decides how the machine behaves.

    Compare it with the acceptance protocol, or with another computer.

    [bold]Examples[/bold]

      timberhand config show

      timberhand config show --json > accepted.json
    """
    from timberhand.configuration.settings_file import INSTALLED, effective, parts, profile_word

    path = file or INSTALLED
    settings = effective(path)
    profile = settings["PROFILE"][0].value
    machine, files = profile_word(profile), list(parts(path, profile))
    if as_json:
        values = {name: {"value": s.value, "changed": changed} for name, (s, changed) in settings.items()}
        contents = [{"kind": part.kind, "path": str(part.path), "sha256": part.sha256} for part in files]
        print(json.dumps({"machine": machine, "settings": values, "files": contents}, indent=2))
        return
    print(machine)
    for name, (setting, changed) in settings.items():
        print(f"  {name}={setting.value}{'   # changed here' if changed else ''}")
    for part in files:
        print(f"  {part.sha256[:16]}  {part.kind:<9} {part.path}")


@app.command()
def diff(
    first: Annotated[Path, typer.Argument(metavar="FIRST", help="Settings file, profile, envelope or truth.")],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="The file to compare with.")],
    as_json: JsonOption = False,
) -> None:
    """Compare two files by their values: order, comments and layout do not count.

    Exit code 6 when they differ.

    [bold]Examples[/bold]

      timberhand config diff machine/palms_471.toml calibrated.toml
    """
    from timberhand.configuration.settings_file import differences

    changes = differences(first, second)
    if as_json:
        print(json.dumps([{"key": key, "first": a, "second": b} for key, a, b in changes], indent=2, default=str))
    else:
        for key, a, b in changes:
            print(f"{key}: {'–' if a is None else a} → {'–' if b is None else b}")
    if changes:
        raise typer.Exit(ExitCode.FIGURE_MISSED)


@app.command()
def migrate(
    file: File = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the new file instead of writing it.")] = False,
) -> None:
    """Bring a settings file of a former release to this one: its values, in this release's file with its words.

    The old file stays beside it as FILE.old. A line that is no setting is
    refused: what it meant would be lost.

    [bold]Examples[/bold]

      sudo timberhand config migrate

      timberhand config migrate old.conf --dry-run
    """
    from timberhand.configuration.settings_file import INSTALLED, SHIPPED, Problem, migrated, parse, read

    path = file or INSTALLED
    text = read(path)
    problems: list[Problem] = []
    parse(text, problems)
    if problems:
        sentence = f"{path}:{problems[0].line}: {problems[0].sentence}; then migrate again"
        raise CommandFailed("config.no-setting", sentence)
    new, notes = migrated(text, read(SHIPPED))
    for note in notes:
        print(note, file=sys.stderr)
    if dry_run:
        print(new, end="")
    elif new == text:
        print(f"{path} is of this release", file=sys.stderr)
    else:
        try:
            fresh = path.with_name(f"{path.name}.migrated")
            fresh.write_text(new)
            fresh.chmod(path.stat().st_mode & 0o777)
            path.with_name(f"{path.name}.old").write_text(text)
            os.replace(fresh, path)
        except OSError as error:
            raise CommandFailed("config.not-written", f"{path} cannot be written: {error.strerror}") from None
        print(f"{path} is migrated; the old one is {path.name}.old", file=sys.stderr)


@app.command()
def apply(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder with profile.toml, its envelope, and their signed list.")
    ],
) -> None:
    """Put a machine's own profile and envelope in use: signed, checked, and only while the machine is disarmed.

    The folder holds profile.toml, NAME.envelope.toml, machine.sha256 (by
    sha256sum) and its signature (by timberhand release sign). The former
    files stay for `config revert`. Exit code 3 when they are refused, 5 while
    the machine is armed.

    [bold]Examples[/bold]

      sudo timberhand config apply calibrated/
    """
    from host.release import machine_files
    from host.release.updater import SIGNER

    _refuse_while_armed()
    _tell_profile(machine_files.apply(folder, SIGNER))


@app.command()
def revert() -> None:
    """Put the former profile and envelope in use again, with the same checks.

    [bold]Examples[/bold]

      sudo timberhand config revert
    """
    from host.release import machine_files
    from host.release.updater import SIGNER

    _refuse_while_armed()
    _tell_profile(machine_files.revert(SIGNER))


def _refuse_while_armed() -> None:
    from host.release.services import refuse_while_armed, service_mode

    refuse_while_armed(service_mode())


def _tell_profile(profile: Path) -> None:
    from timberhand.configuration.settings_file import INSTALLED, parse

    setting = parse(INSTALLED.read_text(), []).get("PROFILE") if INSTALLED.is_file() else None
    if setting is None or setting.value != str(profile):
        print(f"set PROFILE={profile} in {INSTALLED}, then: systemctl restart timberhand.target")
    else:
        print(f"{profile} is in use from the next start: systemctl restart timberhand.target")
