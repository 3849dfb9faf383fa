"""``timberhand service status``: what systemd's properties mean, and a screen that fits."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from can_dbc.timing.page import InputAge, Timing, TimingWriter
from host.exit_codes import CommandFailed, ExitCode
from tests.codes import numbers_in
from timberhand import service_status as status
from timberhand.cli import app
from timberhand.commands import service
from timberhand.service_status import Status, Unit, duration, number, oldest_first, read_status, read_unit, screen

S = 1_000_000_000
Timings = Callable[..., Timing]


def unit(**found: str) -> Unit:
    usual = {
        "Id": "timberhand-guard.service",
        "Type": "notify",
        "LoadState": "loaded",
        "ActiveState": "active",
        "SubState": "running",
        "Result": "success",
        "ExecMainStatus": "0",
        "NRestarts": "2",
        "StatusText": "Well.",
        "StateChangeTimestampMonotonic": "40000000",
        "ExecMainExitTimestampMonotonic": "0",
    }
    return read_unit(usual | found, 100.0)


def shown(found: Status, width: int, before: Timing | None = None) -> str:
    console = Console(width=width, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(screen(found, before))
    return console.export_text()


def test_a_running_unit() -> None:
    assert unit() == Unit("guard", "running", "", 60.0, 2, "Well.")


ENDED = {"ExecMainExitTimestampMonotonic": "9"}


@pytest.mark.parametrize(
    ("active", "sub", "more", "state", "numbers"),
    [
        ("activating", "start", {}, "starting", None),
        ("inactive", "dead", {"LoadState": "not-found"}, "not installed", None),
        ("inactive", "dead", {}, "stopped", None),
        ("inactive", "dead", {"Result": "exec-condition"}, "not configured", None),
        ("inactive", "dead", ENDED, "stopped", None),
        ("inactive", "dead", ENDED | {"Type": "oneshot"}, "done", None),
        ("failed", "failed", {"Result": "exit-code", "ExecMainStatus": "3"}, "failed", [3]),
        ("failed", "failed", {"Result": "exit-code", "ExecMainStatus": "77"}, "failed", [77]),
        ("activating", "auto-restart", {"Result": "watchdog", "ExecMainStatus": "9"}, "restarting", []),
        ("activating", "auto-restart", {"Result": "signal", "ExecMainStatus": "11"}, "restarting", [11]),
    ],
)
def test_what_systemd_means(
    active: str, sub: str, more: dict[str, str], state: str, numbers: list[float] | None
) -> None:
    seen = unit(ActiveState=active, SubState=sub, **more)
    assert seen.state == state and bool(seen.why) == (numbers is not None) and numbers_in(seen.why) == (numbers or [])


def test_a_unit_that_failed_without_a_status_text_shows_its_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status, "last_journal_line", lambda name: f"{name}: no such bus")
    failed = {"ActiveState": "failed", "Result": "exit-code", "ExecMainStatus": "4", "StatusText": ""}
    assert unit(**failed).words == "timberhand-guard.service: no such bus"
    assert unit(StatusText="").words == "", "not of one that runs"


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_screen_fits_and_cuts_nothing(timing: Timings, width: int) -> None:
    units = (Unit("controller", "failed", "exit status 4, bus", 3 * 86400.0, 12, "A sentence " * 12), unit())
    text = shown(Status(units, timing(missed=3), ("A note.",)), width, timing(50))
    assert "…" not in text and max(map(len, text.splitlines())) <= width
    for words in ("exit status 4, bus", "3 d 0 h", "STANDBY", "DOWN", "A note."):
        assert words in " ".join(text.split()), words
    assert len(text.splitlines()) <= 50


def test_the_oldest_input_comes_first_and_one_never_received_is_named(timing: Timings) -> None:
    assert [name for name, _ in oldest_first(list(timing().facts.inputs.items()))][:2] == ["Input6", "Input5"]
    text = shown(Status((), timing(), ()), 80)
    assert text.index("Input6") < text.index("Input5") < text.index("Input3")
    assert "Input2" not in text and 3 in numbers_in(text) and "Never" in text


def test_refused_frames_are_shown_with_the_worst_first(timing: Timings) -> None:
    inputs = {"EncSlew": InputAge(1, 1, 9, 3), "EstopStat": InputAge(1, 1, 9, 17), "EncLift": InputAge(1, 1, 9)}
    text = " ".join(shown(Status((), timing(inputs=inputs), ()), 100).split())
    assert "EstopStat 17, EncSlew 3" in text


def test_an_old_page_says_so(timing: Timings) -> None:
    fresh = shown(Status((), timing(), ()), 80)
    old = shown(Status((), timing(written_ns=timing().facts.written_ns - 12 * S), ()), 80)
    assert 12 in numbers_in(old) and 12 not in numbers_in(fresh)


def test_the_last_second_stands_beside_all_time(timing: Timings) -> None:
    before, now = timing(100, started_ns=5), timing(300, started_ns=5)
    text = shown(Status((), now, ()), 100, before)
    assert "(+200)" in text
    another_life = shown(Status((), timing(300, started_ns=6), ()), 100, before)
    assert "(+" not in another_life


@pytest.fixture
def page(timing: Timings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A controller's timing page on a computer without systemd."""
    monkeypatch.setattr(status, "SYSTEMD", tmp_path / "nothing")
    writer, written = TimingWriter(tmp_path / "page"), timing(10)
    writer.publish(written.facts, written.durations)
    yield tmp_path / "page"
    writer.close()


def test_without_systemd_there_is_the_page_alone(page: Path) -> None:
    seen = read_status(page)
    assert seen.units == () and not seen.silent and len(seen.notes) == 1
    done = CliRunner().invoke(app, ["service", "status", "--json", "--timing", str(page)])
    document = json.loads(done.stdout)
    told = document["timing"]
    assert told["pid"] == 4711 and told["durations"]["wake"]["p50_us"] == pytest.approx(10.0, abs=1.0)
    assert told["silent"] is False and document["units"] == [] and "longest_ns" not in told


@pytest.mark.parametrize("words", [["--json"], []])
def test_watching_goes_on_until_it_is_interrupted(
    words: list[str], page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(service.time, "sleep", pause)
    done = CliRunner().invoke(app, ["service", "status", "--watch", *words, "--timing", str(page)])
    assert (done.exit_code, len(pauses)) == (ExitCode.INTERRUPTED, 3)
    if words:
        assert [json.loads(line)["timing"]["pid"] for line in done.stdout.splitlines()] == [4711] * 3
    else:
        assert "process 4711" in done.stdout


def test_without_services_and_timing_the_command_fails_with_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status, "SYSTEMD", tmp_path / "nothing")
    done = CliRunner().invoke(app, ["service", "status", "--timing", str(tmp_path / "page")])
    assert done.exit_code != 0
    assert isinstance(done.exception, CommandFailed) and done.exception.code == "service.nothing-found"


def test_numbers_and_durations() -> None:
    assert number(1_234_567) == "1\N{NO-BREAK SPACE}234\N{NO-BREAK SPACE}567"
    assert [duration(s) for s in (0.44, 59.0, 61.0, 7384.0, 90000.0)] == [
        "0.4 s",
        "59 s",
        "1 min 1 s",
        "2 h 3 min",
        "1 d 1 h",
    ]
