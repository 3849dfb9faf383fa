"""Branch coverage of supervisor and guard by their own tests, in the run that tests them: ``pytest --branch-coverage``.

Only tests that `tests.safety_scope` names count: a line that a run of the whole machine happens to pass is not tested
by that.  A branch that none of them takes fails the run.  Every worker measures its share; the run adds them up.
"""

from __future__ import annotations

import importlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from coverage import Coverage

from tests.safety_scope import SCOPES, is_measured

OPTION = "--branch-coverage"
_SOURCES = [str(path) for scope in SCOPES for path in scope.sources().values()]


class Measurement:
    """Measures while the modules are imported, which runs statements, and while a test of the scope runs."""

    def __init__(self, data: Path) -> None:
        self._coverage = Coverage(data_file=str(data), data_suffix=True, branch=True, include=_SOURCES)
        self._coverage.start()
        for scope in SCOPES:
            for module in scope.sources():
                importlib.import_module(module)
        self._coverage.stop()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        if not is_measured(item.path, getattr(item, "originalname", item.name)):
            return (yield)
        self._coverage.start()
        try:
            return (yield)
        finally:
            self._coverage.stop()

    def pytest_sessionfinish(self) -> None:
        self._coverage.stop()
        self._coverage.save()


class Verdict:
    """Adds up what the workers measured, prints the lines and branches left out, and fails the run for them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._share = 0.0

    def pytest_configure_node(self, node: object) -> None:
        """A worker of pytest-xdist is told where to put its share."""
        node.workerinput["branch_coverage"] = str(self._folder)  # type: ignore[attr-defined]

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if session.exitstatus not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):  # interrupted
            shutil.rmtree(self._folder)
            return
        whole = Coverage(data_file=str(self._folder / "share"), branch=True, include=_SOURCES)
        whole.exclude(r"if __name__ == .__main__.:")
        whole.combine([str(self._folder)])
        self._share = whole.report(show_missing=True, skip_covered=True)
        shutil.rmtree(self._folder)
        if self._share < 100.0 and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: object) -> None:
        line = f"branches of supervisor and guard taken by their own tests: {self._share:.1f} %, 100 % wanted"
        terminalreporter.write_line(line)  # type: ignore[attr-defined]


def configure(config: pytest.Config) -> None:
    """Measure in this process, or in its workers."""
    given = getattr(config, "workerinput", {}).get("branch_coverage")
    if given is None and not config.getoption(OPTION):
        return
    folder = Path(given or tempfile.mkdtemp(prefix="branch-coverage-"))
    if given is None:
        config.pluginmanager.register(Verdict(folder))
    if given is not None or not config.getoption("numprocesses", None):
        config.pluginmanager.register(Measurement(folder / "share"))
