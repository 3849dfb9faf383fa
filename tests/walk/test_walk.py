"""What `python -m tests.walk` counts: files of the project and calls between them, from `step` on."""

from __future__ import annotations

from tests.controller.bench import Bench
from tests.docs.pages import ROOT
from tests.walk.__main__ import CODECS, file_of, walked


def test_only_files_of_the_project_count() -> None:
    assert file_of(f"{ROOT}/controller/step.py") == "controller/step.py"
    assert file_of(f"{ROOT}/tests/controller/bench.py") is None
    assert file_of(f"{ROOT}/.venv/lib/python3.11/site-packages/msgspec/__init__.py") is None
    assert file_of("/usr/lib/python3.11/enum.py") is None and file_of("<string>") is None


def test_a_tick_is_walked_from_step_on() -> None:
    walk = walked(Bench().active(), [])
    files = walk.calls.keys()
    assert {"controller/step.py", "controller/supervisor.py", CODECS} <= files
    assert not any(name.startswith(("tests", "hil", "sim")) for name in files)
    assert walk.jumps["controller/step.py", "controller/supervisor.py"] > 0
    assert not any(count for (a, b), count in walk.jumps.items() if a == b or not a)
    assert walk.calls.total() > walk.jumps.total() > len(files) - 2


def test_a_tick_of_a_fixed_crane_is_followed_in_at_most_thirty_files() -> None:
    assert len(walked(Bench().active(), []).calls) <= 30
