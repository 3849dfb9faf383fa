"""``timberhand dbc check``, ``record``, ``recording decode`` and ``bench codec`` from the outside."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from can_dbc.dbc import codec
from can_dbc.protocols.e2e import protect
from host.exit_codes import ExitCode
from runtime.errors import TimberhandError
from tests.codes import exit_code_of
from timberhand.cli import app
from timberhand.commands import bench_codec, dbc, recording

OVERLAP = (
    'VERSION ""\nNS_ :\nBS_:\nBU_: A\nBO_ 1 M: 8 A\n'
    ' SG_ X : 0|8@1+ (1,0) [0|0] "" A\n SG_ Y : 7|8@1+ (1,0) [0|0] "" A\n'
)
SOUND = OVERLAP.replace("7|8", "8|8")


def run(app: object, *arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(a) for a in arguments])  # type: ignore[arg-type]
    if isinstance(result.exception, TimberhandError):
        return exit_code_of(result.exception), str(result.exception)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


@pytest.mark.parametrize(
    ("text", "options", "code", "named"),
    [
        (SOUND, [], ExitCode.OK, "GenMsgCycleTime"),
        (SOUND, ["--strict"], ExitCode.CONFIGURATION, "GenMsgCycleTime"),
        (OVERLAP, [], ExitCode.CONFIGURATION, "f.dbc:5:"),
        ("rubbish", [], ExitCode.CONFIGURATION, "f.dbc:1:"),
        (None, [], ExitCode.CONFIGURATION, "f.dbc"),
    ],
)
def test_check(tmp_path: Path, text: str | None, options: list[str], code: int, named: str) -> None:
    path = tmp_path / "f.dbc"
    if text is not None:
        path.write_text(text)
    got, output = run(dbc.app, "check", path, "--frames", 5, *options)
    assert got == code and named in output, output


def test_check_shipped_files_as_json() -> None:
    code, output = run(dbc.app, "check", *codec.SHIPPED, "--frames", 3, "--json")
    files = json.loads(output)["files"]
    assert code == 0
    assert [Path(f["path"]).stem for f in files] == list(codec.SHIPPED)
    assert all(f["decoded"] == 3 * f["messages"] and not f["different"] and not f["warnings"] for f in files)


def test_check_reports_a_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("can_dbc.dbc.check.compare_decode", lambda *_: ["M decode 00: ours 1, cantools 2"])
    code, output = run(dbc.app, "check", "gnss", "--frames", 1)
    assert code == ExitCode.FIGURE_MISSED
    assert "ours 1, cantools 2" in output


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    message = codec.load("crane").messages["PressA"]
    assert message.data_ids
    data = protect(message.encode(0, 0, 0, 1.0, 2.0, None, 4.0), 3, message.data_ids).hex().upper()
    path = tmp_path / "x.log"
    path.write_text(f"(1.000000) can0 1A0#{data}\n(1.000001) can0 1A0#{data[:-1]}\n(1.1) can0 7FF#\n")
    return path


def test_log_decode(recorded: Path) -> None:
    code, output = run(recording.app, "decode", recorded, "--dbc", "crane")
    assert code == 0
    assert "PressA" in output and "LiftB=2 bar" in output


@pytest.mark.parametrize(("options", "entries"), [([], 1), (["--quiet"], 0), (["--dbc", "machine"], 0)])
def test_log_decode_as_json(recorded: Path, options: list[str], entries: int) -> None:
    code, output = run(recording.app, "decode", recorded, "--json", *options)
    document = json.loads(output)
    assert (code, len(document["frames"])) == (0, entries)
    assert document["summary"]["frames"] == 2
    assert document["summary"]["broken"] == 1
    if entries:
        entry = document["frames"][0]
        assert (entry["name"], entry["values"]["LiftB"], entry["labels"]["Status"]) == ("PressA", 2.0, "Ok")


@pytest.mark.parametrize(("log_name", "dbc_name"), [("nowhere.log", "crane"), ("x.log", "nowhere.dbc"), (".", "crane")])
def test_log_decode_refuses(recorded: Path, log_name: str, dbc_name: str) -> None:
    code, sentence = run(recording.app, "decode", recorded.parent / log_name, "--dbc", dbc_name)
    assert code == ExitCode.CONFIGURATION
    assert "\n" not in sentence.strip()


def test_bench_codec_measures_every_message() -> None:
    result = bench_codec.measure(3)
    assert {row["message"] for row in result["messages"]} == set(codec.load("crane").messages)
    assert set(result["ratios"]) >= set(result["needed"])
    assert all(ratio > 0 for ratio in result["ratios"].values())
    reached = all(result["ratios"][name] >= needed for name, needed in result["needed"].items())
    assert result["reached"] is reached
    assert json.loads(json.dumps(result)) == result


@pytest.mark.parametrize("options", [[], ["--json"], ["--quiet"]])
@pytest.mark.parametrize(
    ("name", "content"), [("x.log", b"hello\n"), ("x.blf", b"LOGG"), ("x.asc", b""), ("y.log", b"# \n")]
)
def test_a_file_without_a_readable_frame_is_refused(
    tmp_path: Path, name: str, content: bytes, options: list[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    code, sentence = run(recording.app, "decode", tmp_path / name, "--dbc", "crane", *options)
    assert code == ExitCode.CONFIGURATION
    assert name in sentence and "\n" not in sentence.strip()


@pytest.mark.parametrize("key", [(), ("--key-file", "key")])
def test_record_gives_the_recorder_its_key(key: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[str] = []
    monkeypatch.setattr("recorder.__main__.main", given.extend)
    run(app, "record", "--out", "run", *key)
    assert tuple(given[given.index("--key-file") :] if "--key-file" in given else ())[:2] == key
