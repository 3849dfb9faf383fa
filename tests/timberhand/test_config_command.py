"""``timberhand config``: what is wrong with settings, what a machine consists of, two files by their values."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from host.exit_codes import ExitCode
from runtime.errors import TimberhandError
from timberhand.cli import app
from timberhand.configuration.check import problems_of
from timberhand.configuration.settings_file import SHIPPED, migrated, parse

TEXT = SHIPPED.read_text()
RUNNER = CliRunner()


def changed(name: str, value: str) -> str:
    """The shipped settings with one value of another kind."""
    lines = [f"{name}={value}" if line.startswith(f"{name}=") else line for line in TEXT.splitlines()]
    assert f"{name}={value}" in lines
    return "\n".join(lines) + "\n"


def test_the_shipped_settings_have_no_problem() -> None:
    assert problems_of(TEXT, TEXT) == []
    assert problems_of(changed("CRANE_BUS", "python-can:socketcan:crane0"), TEXT) == []


@pytest.mark.parametrize(
    ("text", "named", "line"),
    [
        (changed("SETPOINT_PORT", "24702"), "24702", "PLANNER_PORT"),
        (changed("SETPOINT_PORT", "9000"), "24799", "SETPOINT_PORT"),
        (changed("CONSOLE_PORT", "24750"), "8999", "CONSOLE_PORT"),
        (changed("CONSOLE_PORT", "page"), "8999", "CONSOLE_PORT"),
        (changed("SCENE", "camera"), "HOST:PORT", "SCENE"),
        (changed("CRANE_BUS", "can0"), "socketcan:INTERFACE", "CRANE_BUS="),
        (changed("CRANE_BUS", ""), "socketcan:crane0", "CRANE_BUS="),
        (changed("CRANE_BITRATE", "2000000"), "2000000", "CRANE_BITRATE"),
        (changed("MACHINE_BUS", "socketcan:mach0"), "MACHINE_BUS", "MACHINE_BUS="),
        (changed("PROFILE", "aoro_fc8"), "MACHINE_BUS", "MACHINE_BUS="),
        (changed("PROFILE", "palms"), "PROFILE=palms", "PROFILE"),
        (changed("PLC", "--modbus 192.168.7.2:502"), "[plc]", "PLC="),
        (changed("CAMERA", "moon"), "d435", "CAMERA="),
        (TEXT + "CRANE_BUSS=x\n", "CRANE_BUS", "CRANE_BUSS"),
        (TEXT + "KEY_OPTIONS=\n", "KEY_OPTIONS", "KEY_OPTIONS"),
        (TEXT + "CRANE_BUS = x\n", "CRANE_BUS", "CRANE_BUS = x"),
        (TEXT + "PLC=\n", "PLC", "PLC="),
        (TEXT.replace("\nSCENE=", "\n# SCENE="), "SCENE", ""),
    ],
)
def test_what_is_wrong_is_said_with_its_line_and_what_to_do(text: str, named: str, line: str) -> None:
    (found,) = (problem for problem in problems_of(text, TEXT) if named in problem.sentence)
    assert found.line == 0 if not line else text.splitlines()[found.line - 1].startswith(line)


def test_a_setting_that_is_missing_is_a_note_because_the_release_ships_it(tmp_path: Path) -> None:
    conf = tmp_path / "old.conf"
    conf.write_text(TEXT.replace("\nSCENE=", "\n# SCENE="))
    done = RUNNER.invoke(app, ["config", "check", str(conf), "--json"])
    assert done.exit_code == 0 and [problem["note"] for problem in json.loads(done.stdout)["problems"]] == [True]


def test_a_profile_beyond_its_envelope_is_found_before_the_guard_refuses_to_start(tmp_path: Path) -> None:
    profile = Path("machine/palms_471.toml").read_text()
    limit = next(line for line in profile.splitlines() if line.startswith("speed_limit"))
    (tmp_path / "mine.toml").write_text(profile.replace(limit, limit.split("=")[0] + "= 0.9", 1))
    found = problems_of(changed("PROFILE", str(tmp_path / "mine.toml")), TEXT)
    assert len(found) == 1 and "speed_limit" in found[0].sentence


def test_the_command_names_the_file_and_its_line_and_fails(tmp_path: Path) -> None:
    conf = tmp_path / "own.conf"
    conf.write_text(changed("SETPOINT_PORT", "1"))
    done = RUNNER.invoke(app, ["config", "check", str(conf)])
    assert done.exit_code == ExitCode.CONFIGURATION and done.stdout.startswith(f"{conf}:")
    found = json.loads(RUNNER.invoke(app, ["config", "check", str(conf), "--json"]).stdout)
    assert [problem["line"] for problem in found["problems"]] == [parse(conf.read_text(), [])["SETPOINT_PORT"].line]
    missing = RUNNER.invoke(app, ["config", "check", str(tmp_path / "none")])
    assert isinstance(missing.exception, TimberhandError) and missing.exception.code == "settings.unreadable"


def test_show_tells_every_file_that_decides_what_the_machine_does(tmp_path: Path) -> None:
    conf = tmp_path / "own.conf"
    conf.write_text(changed("CRANE_BITRATE", "500000"))
    shown = json.loads(RUNNER.invoke(app, ["config", "show", str(conf), "--json"]).stdout)
    assert shown["settings"]["CRANE_BITRATE"] == {"value": "500000", "changed": True}
    assert not shown["settings"]["PROFILE"]["changed"]
    kinds = {part["kind"] for part in shown["files"]}
    assert kinds == {"settings", "profile", "envelope", "frames", "objects", "weights"}
    for part in shown["files"]:
        assert hashlib.sha256(Path(part["path"]).read_bytes()).hexdigest() == part["sha256"]


def test_diff_compares_values_and_not_layout(tmp_path: Path) -> None:
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text("[valve]\ndelay_s = 0.1 # measured\ngain = 2\n")
    two.write_text("[valve]\ngain = 2\ndelay_s = 0.2\nlag_s = 0.05\n")
    done = RUNNER.invoke(app, ["config", "diff", str(one), str(two)])
    assert done.exit_code == ExitCode.FIGURE_MISSED
    assert done.stdout.splitlines() == ["valve.delay_s: 0.1 → 0.2", "valve.lag_s: – → 0.05"]
    assert RUNNER.invoke(app, ["config", "diff", str(one), str(one)]).exit_code == 0


def test_diff_names_the_file_that_is_broken(tmp_path: Path) -> None:
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text("gain = 2\n")
    two.write_text("gain =\n")
    refused = RUNNER.invoke(app, ["config", "diff", str(one), str(two)]).exception
    assert isinstance(refused, TimberhandError) and refused.code == "settings.broken-toml"
    assert str(two) in str(refused) and str(one) not in str(refused)


def test_migrate_keeps_values_takes_this_release_s_words_and_leaves_the_old_file(tmp_path: Path) -> None:
    old = "PROFILE=aoro_fc8\nKEY_OPTIONS=--key-file /etc/timberhand/key\nMACHINE_BUS=socketcan:mach0\n"
    new, notes = migrated(old, TEXT)
    values = {name: setting.value for name, setting in parse(new, []).items()}
    shipped = {name: setting.value for name, setting in parse(TEXT, []).items()}
    assert values == shipped | {"PROFILE": "aoro_fc8", "MACHINE_BUS": "socketcan:mach0"}
    assert any(note.startswith("KEY_OPTIONS=") for note in notes)
    assert migrated(new, TEXT) == (new, [])
    conf = tmp_path / "timberhand.conf"
    conf.write_text(old)
    assert RUNNER.invoke(app, ["config", "migrate", str(conf), "--dry-run"]).exit_code == 0
    assert conf.read_text() == old
    assert RUNNER.invoke(app, ["config", "migrate", str(conf)]).exit_code == 0
    assert (conf.read_text(), (tmp_path / "timberhand.conf.old").read_text()) == (new, old)
    assert problems_of(conf.read_text(), TEXT) == []


@pytest.mark.parametrize("line", ["PROFILE = aoro_fc8", "AUTONOMY_OPTIONS=--mission a \\\n  --order-port 24705"])
def test_migrate_refuses_a_file_whose_lines_it_would_lose(line: str, tmp_path: Path) -> None:
    """systemd reads blanks around the sign and continued lines, so the machine may run with them."""
    conf = tmp_path / "timberhand.conf"
    conf.write_text(f"CRANE_BITRATE=500000\n{line}\n")
    refused = RUNNER.invoke(app, ["config", "migrate", str(conf)]).exception
    assert isinstance(refused, TimberhandError) and refused.code == "config.no-setting"
    assert f"{conf}:{1 + len(line.splitlines())}: " in str(refused)
    assert [path.name for path in tmp_path.iterdir()] == [conf.name] and line in conf.read_text()


def test_show_tells_the_settings_in_force_also_those_that_the_file_lacks(tmp_path: Path) -> None:
    conf = tmp_path / "short.conf"
    conf.write_text("CRANE_BITRATE=500000\n")
    shown = json.loads(RUNNER.invoke(app, ["config", "show", str(conf), "--json"]).stdout)
    assert shown["machine"].startswith("palms_471")
    assert shown["settings"].keys() == parse(TEXT, []).keys()
    assert [name for name, found in shown["settings"].items() if found["changed"]] == ["CRANE_BITRATE"]
