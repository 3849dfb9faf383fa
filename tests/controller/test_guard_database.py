"""What the guard demands of the databases before it starts, and a frame that comes twice."""

from __future__ import annotations

import shutil

import pytest

from controller.guard.__main__ import DATABASES, build
from controller.guard.layout import GuardConfigError
from controller.guard.verdicts import Verdict
from tests.codes import coded
from tests.controller.bench import DATABASE
from tests.controller.guard_traffic import PROFILE, Traffic


@pytest.fixture
def databases(tmp_path):
    for name in ("crane.dbc", "machine.dbc"):
        shutil.copy(DATABASES / name, tmp_path)
    return tmp_path


def changed(folder, old, new):
    path = folder / "crane.dbc"
    text = path.read_text(encoding="cp1252")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="cp1252")


def test_the_shipped_databases_make_a_guard(databases):
    assert not build(PROFILE, databases).enabled


@pytest.mark.parametrize(
    ("pattern", "new", "code"),
    [
        (f'BA_ "E2EDataIds" BO_ {DATABASE.message("EstopStat").key} "', "01 ", "guard.data-ids"),
        (f'BA_ "TimeoutMs" BO_ {DATABASE.message("EstopStat").key} ', "// ", "guard.message-unprotected"),
        (" SG_ Slew : ", "", "guard.no-command-signal"),
    ],
)
def test_a_database_without_protection_time_out_or_signal_stops_the_start(databases, pattern, new, code):
    if code == "guard.no-command-signal":
        changed(databases, pattern, " SG_ Swing : ")
    elif code == "guard.data-ids":
        changed(databases, pattern, pattern + new)
    else:
        changed(databases, pattern, f'BA_ "Other" BO_ {DATABASE.message("EstopStat").key} ')
    with pytest.raises(GuardConfigError, check=coded(code)):
        build(PROFILE, databases)


def test_a_database_that_is_not_there_stops_the_start(databases):
    (databases / "crane.dbc").unlink()
    with pytest.raises(GuardConfigError, check=coded("guard.dbc-unreadable")):
        build(PROFILE, databases)


def test_a_frame_that_comes_twice_is_neither_new_nor_a_break():
    traffic = Traffic().good()
    for _ in range(20):
        frame = traffic.frame("ValveCmdA", traffic.a)
        traffic.dropped.add("ValveCmdA")
        traffic.extra += [frame, frame, frame]
        assert traffic.tick() is Verdict.GOOD
    traffic.extra = []
    frame = traffic.frame("ValveCmdA", traffic.a)
    verdicts = set()
    for _ in range(20):
        traffic.extra.append(frame)
        verdicts.add(traffic.tick())
    assert Verdict.NO_COMMAND in verdicts, "a frame that only repeats grows old"
