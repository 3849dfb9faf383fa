"""Every option of every command is read, and one that has no effect in a mode is refused with exit code 2."""

from __future__ import annotations

import dis
import inspect
from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from host.exit_codes import CommandFailed, ExitCode
from timberhand.cli import app
from timberhand.commands.experiment import READERS

VALUES = {"--bus": "wire", "--camera": "stick", "--clock": "real", "--plc-link": "modbus", "--plc-role": "valves"}
"""Of the options that allow certain words; all others take a number."""
LIVE = ("--bus", "--clock", "--console", "--no-console", "--console-port", "--foxglove", "--max-stops")
FILE = "docs/examples/paper_b.geojson"
USELESS = {
    ("demo", "--lockstep"): (*LIVE, "--plc-link"),
    ("demo", "--lockstep", "--plc"): (*LIVE, "--plc-link"),
    ("demo",): ("--plc-role", "--plc-link", "--clock"),
    ("demo", "--no-console"): ("--console-port", "--foxglove"),
    ("demo", "--detector", "perfect"): ("--camera",),
    ("demo", "--bus", "wire"): ("--clock",),
    ("mission", "run", FILE, "--lockstep"): LIVE,
    ("mission", "run", FILE): ("--clock",),
    ("mission", "run", FILE, "--no-console"): ("--console-port", "--foxglove"),
    ("console", "--replay", "runs/LAST"): ("--operator", "--bus", "--passwords"),
    ("why", "--page"): ("--all", "--plot", "--json"),
    ("why",): ("--port",),
    ("doctor",): ("--cpu", "--out", "--seconds", "--bus", "--profile"),
    ("doctor", "--report"): ("--cpu", "--json"),
    ("calibrate", "--profile", "palms_471"): ("--truth", "--seed"),
    ("calibrate", "--profile", "palms_471", "--lockstep"): ("--bus", "--key-file", "--lease-ms"),
    ("inject", "estop"): ("--profile", "--truth"),
    ("inject", "encoder-stuck", "--joint", "lift"): ("--part",),
    ("inject", "estop", "--lockstep"): ("--run", "--i-know"),
    ("replay", "runs/LAST", "--contents"): ("--profile",),
    ("machine", "new", "mine"): ("--urdf-joints",),
    ("bench", "tick"): ("--seed",),
    ("experiment", "plant"): ("--minutes", "--repetitions", "--bus", "--data"),
    ("bench", "tick", "--count"): ("--rounds", "--seed"),
    ("bench", "tick", "--random", "9"): ("--count", "--rounds", "--ticks"),
}
"""What has no effect, by the words before it."""


def commands(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with its words."""
    if not hasattr(group, "commands"):
        yield words, group
        return
    for name, command in group.commands.items():
        yield from commands(command, (*words, name))


ALL = dict(commands(get_command(app)))


def with_value(words: tuple[str, ...], option: str) -> tuple[str, ...]:
    """An option of the command with these words, and a value if it takes one."""
    (command,) = (command for name, command in ALL.items() if words[: len(name)] == name)
    flags = [{*found.opts, *found.secondary_opts} for found in command.params if getattr(found, "is_flag", False)]
    return (option,) if option in set().union(*flags) else (option, VALUES.get(option, "9000"))


@pytest.mark.parametrize("words", ALL, ids=" ".join)
def test_every_option_has_a_reader(words: tuple[str, ...]) -> None:
    callback = inspect.unwrap(ALL[words].callback)
    loaded = {i.argval for i in dis.get_instructions(callback) if i.opname.startswith(("LOAD_FAST", "LOAD_DEREF"))}
    loaded |= {i.argval for i in dis.get_instructions(callback) if i.opname == "LOAD_CLOSURE"}
    names = {parameter.name for parameter in ALL[words].params} & set(inspect.signature(callback).parameters)
    assert names <= loaded, f"nothing reads {names - loaded}"


@pytest.mark.parametrize(
    ("words", "option"),
    [(words, option) for words, options in USELESS.items() for option in options],
    ids=lambda part: part if isinstance(part, str) else " ".join(part),
)
def test_an_option_without_effect_is_refused(words: tuple[str, ...], option: str) -> None:
    done = CliRunner().invoke(app, [*words, *with_value(words, option)])
    assert isinstance(done.exception, CommandFailed), done.output
    assert (done.exception.code, done.exception.exit_code) == ("option.no-effect", ExitCode.USAGE)


def test_a_port_that_no_computer_has_is_refused_at_once() -> None:
    ports = [
        (*words, option.opts[0], getattr(option, "max", None))
        for words, command in ALL.items()
        for option in command.params
        if option.opts[0].endswith(("-port", "--foxglove"))
    ]
    assert ports and not [port for port in ports if port[-1] != 65535]


@pytest.mark.parametrize("words", [("demo",), ("mission", "run", FILE)], ids=" ".join)
def test_a_page_has_a_port(words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(app, [*words, "--console-port", "0"], env={"COLUMNS": "200"})
    assert done.exit_code == ExitCode.USAGE and "--console-port" in done.output


def test_the_help_of_an_option_names_every_experiment_that_reads_it() -> None:
    command: Any = get_command(app)
    command = command.commands["experiment"]
    helps = {parameter.name: parameter.help for parameter in command.params if parameter.name in READERS}
    assert helps.keys() == READERS.keys()
    for name, readers in READERS.items():
        assert [reader for reader in readers if f"{reader}:" not in helps[name]] == [], name
