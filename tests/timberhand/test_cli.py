"""The command line as a whole: version, errors and their codes, directories of runs, what is handed on."""

from __future__ import annotations

import io
import os
import pickle
import signal
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

import deploy.__main__ as installer
from experiments.common.result import sealed_seed
from host.exit_codes import CommandFailed, ExitCode
from tests.autonomy.crane_stand_in import HOME
from tests.codes import coded
from timberhand import cli
from timberhand.cli import _run, app
from timberhand.commands.runs import new_directory
from timberhand.reference import __main__
from timberhand.reference.__main__ import REPOSITORY

DOCS = Path(__file__).parents[2] / "docs"


def test_a_page_of_the_checkout_is_refused_while_sources_are_not_committed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.common.result.commit", lambda: "0123456789ab+changes")
    refused = CliRunner().invoke(app, ["experiment", "plant", "--quick", "--docs", str(DOCS)])
    assert isinstance(refused.exception, CommandFailed) and refused.exception.code == "experiment.uncommitted"
    sealed = CliRunner().invoke(app, ["experiment", "plant", "--quick", "--sealed"])
    assert isinstance(sealed.exception, CommandFailed) and sealed.exception.code == "experiment.uncommitted"


def test_a_sealed_run_gets_the_seed_of_its_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr("experiments.common.result.commit", lambda: "0123456789ab")
    monkeypatch.setattr("experiments.common.registry.load", lambda _: lambda options, _: given.append(options.seed))
    CliRunner().invoke(app, ["experiment", "plant", "--sealed"])
    assert given == [sealed_seed("0123456789ab", "plant")]


def test_the_version_is_that_of_the_package() -> None:
    done = CliRunner().invoke(app, ["--version"])
    assert done.exit_code == 0 and done.stdout == f"timberhand {version('timberhand')}\n"


def test_a_command_failure_crosses_process_boundaries() -> None:
    failure = CommandFailed("area.what", "a sentence", ExitCode.BUS)
    copy = pickle.loads(pickle.dumps(failure))
    assert (copy.code, str(copy), copy.exit_code) == ("area.what", "a sentence", ExitCode.BUS)


def test_a_code_belongs_to_one_area_of_the_program() -> None:
    """Codes begin with their area; one area is one package, or the program's own commands about it."""
    for code, places in __main__.codes(REPOSITORY).items():
        assert __main__.CODE.fullmatch(code), code
        assert len({taker for taker, _, _ in places}) <= 2, f"{code} is raised as {places}"


def test_runs_that_begin_side_by_side_get_directories_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: new_directory("run"), range(40)))
    assert len(set(made)) == 40 and all(one.is_dir() for one in made)
    assert Path("runs/LAST").resolve().name.startswith("run-")
    assert sorted(p.name for p in Path("runs").iterdir() if p.name.startswith(".")) == []


def test_the_last_run_is_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        assert new_directory("a") == Path(f"runs/a-{number}")
        assert Path("runs/LAST").resolve().name == f"a-{number}"


@pytest.mark.parametrize("place", ["runs", "runs/LAST/run"])
def test_a_run_that_cannot_be_kept_is_said(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path(place).parent.mkdir(parents=True, exist_ok=True)
    Path(place).touch()
    with pytest.raises(CommandFailed, check=coded("runs.not-made")):
        new_directory("a")


def test_a_page_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    refused = CliRunner().invoke(app, ["mission", "states", "--docs", str(tmp_path / "none")]).exception
    assert isinstance(refused, CommandFailed) and refused.code == "mission.page-not-written"


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--out", "mine"], "calibrate.output-name"),
        (["--out", "file/mine.toml"], "calibrate.no-folder"),
        (["--out", "mine.toml", "--report", "file"], "calibrate.no-folder"),
    ],
)
def test_a_calibration_that_could_not_be_kept_does_not_begin(
    words: list[str], code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    refused = CliRunner().invoke(app, ["calibrate", "--profile", "palms_471", "--lockstep", *words]).exception
    assert isinstance(refused, CommandFailed) and refused.code == code


def test_a_calibration_without_matplotlib_does_not_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("timberhand.commands.calibrate.find_spec", lambda _: None)
    monkeypatch.setattr("timberhand.commands.calibrate._lockstep", lambda *_: pytest.fail("it moves"))
    words = ["calibrate", "--profile", "palms_471", "--lockstep", "--out", str(tmp_path / "mine.toml")]
    refused = CliRunner().invoke(app, words).exception
    assert isinstance(refused, CommandFailed) and refused.code == "calibrate.no-matplotlib"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("implausible", "code"),
    [([], "calibrate.report-not-written"), ([SimpleNamespace(sentence="no")], "calibrate.implausible")],
)
def test_a_report_that_cannot_be_written_costs_no_profile(
    implausible: list[object], code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine" / "result.json").mkdir(parents=True)
    run = SimpleNamespace(found=None, elapsed_s=240.0, resumptions=0)
    result = SimpleNamespace(implausible=implausible, joints={}, turns=None, survey=None, grapple_s={}, kept=())
    monkeypatch.setattr("timberhand.commands.calibrate._lockstep", lambda *_: run)
    monkeypatch.setattr("autonomy.calibration.result.identify", lambda *_: result)
    words = ["calibrate", "--profile", "palms_471", "--lockstep", "--out", str(tmp_path / "mine.toml")]
    failed = CliRunner().invoke(app, words).exception
    assert isinstance(failed, CommandFailed) and failed.code == code
    assert "result.json" in str(failed) and (tmp_path / "mine.toml").exists() is not bool(implausible)


def test_ctrl_c_at_a_question_of_the_survey_ends_the_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked once: until the machine rests, the run would like its reading."""
    asked, runs = [], []

    def question(words: str) -> str:
        asked.append(words)
        signal.raise_signal(signal.SIGINT)
        return "1 2 3"

    def run(run: Any, _link: object, _bus: object, reader: Any, turn: Any) -> None:
        runs.append(run)
        assert (reader.read(0), reader.read_yaw(0)) == (None, None)
        turn(run)

    monkeypatch.setattr("typer._click.termui.visible_prompt_func", question)
    monkeypatch.setattr("autonomy.calibration.live.first_report", lambda *_: SimpleNamespace(position=HOME))
    monkeypatch.setattr("autonomy.calibration.live.run", run)
    monkeypatch.setattr("can_dbc.bus.factory.open_bus", lambda *_, **__: nullcontext())
    words = ["calibrate", "--profile", "palms_471", "--survey", "ask", "--yes", "--report-port", "0"]
    with pytest.raises(CommandFailed, check=coded("calibrate.interrupted")):
        app([*words, "--out", str(tmp_path / "mine.toml")], standalone_mode=False)
    assert len(asked) == 1 and runs[0].failure_code == "calibration.aborted" and not (tmp_path / "mine.toml").exists()


def test_a_sign_that_the_output_lacks_is_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text("gain = 1\n")
    two.write_text("gain = 2\n")
    output = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(output, "ascii", write_through=True))
    monkeypatch.setattr("sys.argv", ["timberhand", "config", "diff", str(one), str(two)])
    with pytest.raises(SystemExit):
        _run()
    assert output.getvalue() == b"gain: 1 \\u2192 2\n"


@pytest.mark.parametrize("end", [KeyboardInterrupt, EOFError])
def test_a_question_that_is_interrupted_ends_as_interrupted(
    end: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(*_: object) -> str:
        raise end

    monkeypatch.setattr("sys.argv", ["timberhand", "operator", "password", "anna", "--role", "viewer", "--file", "x"])
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("typer._click.termui.hidden_prompt_func", ended)
    with pytest.raises(SystemExit) as done:
        _run()
    assert done.value.code == ExitCode.INTERRUPTED


@pytest.mark.parametrize(
    ("given", "handed_on"),
    [
        (["install"], []),
        (["install", "--wheel", "a.whl", "--cpu", "0", "--dry-run"], ["--wheel", "a.whl", "--cpu", "0", "--dry-run"]),
        (["install", "--from-environment", "/e"], ["--from-environment", "/e"]),
        (["uninstall", "--root", "/r"], ["--uninstall", "--root", "/r"]),
    ],
)
def test_the_installer_is_given_the_options_by_their_own_names(
    monkeypatch: pytest.MonkeyPatch, given: list[str], handed_on: list[str]
) -> None:
    seen: list[str] = []
    monkeypatch.setattr(installer, "install", lambda words: seen.extend(words) or 7)
    assert CliRunner().invoke(app, ["service", *given]).exit_code == 7
    assert seen == handed_on


@pytest.fixture
def signals() -> Iterator[None]:
    """Put back what `main` does to this process's signals."""
    before = {number: signal.getsignal(number) for number in (signal.SIGPIPE, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_connection_that_its_other_side_closes_ends_no_command(
    signals: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    survived = []

    def serve() -> None:
        page, browser = socket.socketpair()
        browser.close()
        with page, pytest.raises(BrokenPipeError):
            page.send(b"state")
        survived.append(signal.getsignal(signal.SIGPIPE))

    monkeypatch.setattr(cli, "_run", serve)
    cli.main()
    assert len(survived) == 1 and signal.getsignal(signal.SIGPIPE) is signal.SIG_DFL, "for what is written at the exit"


def test_a_command_ends_with_the_reader_of_its_output_alone(signals: None, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []
    monkeypatch.setattr(signal, "raise_signal", ended.append)
    reading, writing = os.pipe()
    monkeypatch.setattr(cli, "STDOUT", writing)
    cli._end_with_reader(signal.SIGPIPE, None)
    assert ended == []
    os.close(reading)
    cli._end_with_reader(signal.SIGPIPE, None)
    assert ended == [signal.SIGPIPE] and signal.getsignal(signal.SIGPIPE) is signal.SIG_DFL
    os.close(writing)
