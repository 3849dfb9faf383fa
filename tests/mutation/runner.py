"""Runs the mutants of one scope: each in a forked process that already has pytest, the tests and the module loaded.

Why not mutmut or cosmic-ray (docs/decisions/18-own-mutants.md): a table of transitions, a set of verdicts and the
limits are statements of the module, not of a function, and the present tools either leave those out or start a new
interpreter for every mutant.  Here a mutant in a function replaces that function's code in a fork, and a mutant of a
statement of the module is imported anew in a fork that has not collected yet.

A mutant is *killed* when a test fails, *timeout* when it needs ten times the processor time of its tests or waits for
`IDLE_S` without using any, *survived* when all of them pass.  A mutant that Python refuses, that cannot be imported, or
whose process ends in any other way is *unusable* and counts for nothing.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.abc
import importlib.util
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import pytest
from hypothesis import Phase, settings

from tests.mutation.mutators import Module, Mutant
from tests.safety_scope import Scope

PYTEST = ["-q", "-x", "-s", "-p", "no:cacheprovider", "-p", "no:xdist", "-o", "timeout=0", "-m", "not long"]
CPU_FACTOR, CPU_EXTRA_S = 10.0, 20.0
LONG_S = 15.0
"""A test that needs more processor time, with its lines counted, is left out: what only it finds counts as survived."""
IDLE_S = 60.0
"""A child that sleeps so long waits for what never comes; no test of the scopes waits longer for anything."""
MEMORY_BYTES = 4 << 30
PURGED = ("controller", "tests", "hil", "sim", "recorder")
"""Packages that may hold objects of a mutated module; a mutant of a module's own statements imports them anew."""
KILLED, SURVIVED, UNUSABLE, TIMEOUT = "killed", "survived", "unusable", "timeout"
_CODES = {10: KILLED, 11: SURVIVED}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a mutant; ``by`` is the test that killed it, or why it is unusable."""

    mutant: Mutant
    status: str
    by: str = ""


@dataclass(frozen=True, slots=True)
class Baseline:
    """The unchanged tests: the processor time of all of them [s], and the names of those beyond `LONG_S`."""

    cpu_s: float
    long: tuple[str, ...]


@dataclass(slots=True)
class Covered:
    """What the unchanged tests did: the tests that run each line of each module, and the processor time of each [s]."""

    lines: dict[str, dict[int, list[int]]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)


class TestsFail(Exception):
    """The tests fail without any mutant."""


def quiet_profile() -> None:
    """The same examples every time, and no search for a smaller one: a failure is a kill as it is."""
    settings.register_profile(
        "mutants", deadline=None, derandomize=True, database=None, phases=(Phase.explicit, Phase.generate)
    )
    settings.load_profile("mutants")


# -- forks -------------------------------------------------------------------------------------------------------------


class Forks:
    """At most ``jobs`` children; `start` waits for a free place, `finished` yields what has ended."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._running: dict[int, tuple[Any, int]] = {}
        self._idle: dict[int, tuple[int, float]] = {}
        """Of each child its processor time [clock ticks] and until when it may stay there [s]."""

    def start(self, what: Any, cpu_s: float, work: Callable[[int], int]) -> Iterator[tuple[Any, int | None, str]]:
        """Run ``work(pipe)`` in a child; yields (what, exit code or None for a time-out, words) of those that ended."""
        while len(self._running) >= self._jobs:
            yield from self._wait()
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read)
            _run_child(write, cpu_s, work)
        os.close(write)
        self._running[child] = (what, read)

    def finish(self) -> Iterator[tuple[Any, int | None, str]]:
        """Wait for all of them."""
        while self._running:
            yield from self._wait()

    def _wait(self) -> Iterator[tuple[Any, int | None, str]]:
        select.select([entry[1] for entry in self._running.values()], [], [], 0.5)
        for child, (what, read) in list(self._running.items()):
            ended, status = os.waitpid(child, os.WNOHANG)
            waits = not ended and self._waits(child)
            if waits:
                os.kill(child, signal.SIGKILL)
                ended, status = os.waitpid(child, 0)
            if not ended:
                continue
            del self._running[child]
            self._idle.pop(child, None)
            with os.fdopen(read, "rb") as pipe:
                words = pipe.read().decode(errors="replace")
            if waits:
                yield what, None, f"its tests slept for {IDLE_S:g} s"
            elif os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
                yield what, None, "the processor time of its tests was not enough"
            elif os.WIFSIGNALED(status):
                yield what, -os.WTERMSIG(status), f"ended by signal {os.WTERMSIG(status)}"
            else:
                yield what, os.WEXITSTATUS(status), words

    def _waits(self, child: int) -> bool:
        """Whether a child has slept for `IDLE_S`.  One that a busy computer keeps waiting does not sleep."""
        state, *fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
        used, now_s = int(fields[10]) + int(fields[11]), time.monotonic()
        before, until_s = self._idle.get(child, (-1, now_s))
        if used != before or state == "R":
            self._idle[child] = (used, now_s + IDLE_S)
            return False
        return now_s > until_s


def _run_child(pipe: int, cpu_s: float, work: Callable[[int], int]) -> None:
    """Never returns."""
    code = 1
    try:
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s) + 1, int(cpu_s) + 30))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = work(pipe)
    except BaseException as error:  # noqa: BLE001 - whatever it is, the child must end here
        with contextlib.suppress(OSError):
            os.write(pipe, f"{type(error).__name__}: {error}"[:500].encode(errors="replace"))
    finally:
        os._exit(code)


def _outcome(mutant: Mutant, code: int | None, words: str) -> Outcome:
    if code is None:
        return Outcome(mutant, TIMEOUT, words)
    status = _CODES.get(code, UNUSABLE)
    return Outcome(mutant, status, words if words or status != UNUSABLE else f"exit code {code}")


# -- mutants in functions ----------------------------------------------------------------------------------------------


def function_of(module: ModuleType, mutant: Mutant) -> FunctionType | None:
    """The function around a mutant, None when there is none that could get other code."""
    found: Any = module
    for name in mutant.function.split("."):
        found = vars(found).get(name)
        if isinstance(found, staticmethod | classmethod):
            found = found.__func__
        if isinstance(found, property):
            getters = (found.fget, found.fset)
            found = next((g for g in getters if g and _spans(g, mutant.lines[0])), None)
        if found is None:
            return None
        if isinstance(found, FunctionType):
            found = getattr(found, "__wrapped__", found)
            break
    return found if isinstance(found, FunctionType) and _spans(found, mutant.lines[0]) else None


def _spans(function: FunctionType, line: int) -> bool:
    code = function.__code__
    lines = [at for _, _, at in code.co_lines() if at is not None] + [code.co_firstlineno]
    inner = [at for const in code.co_consts if isinstance(const, CodeType) for _, _, at in const.co_lines() if at]
    return min(lines) <= line <= max(lines + inner)


def code_within(code: CodeType, like: CodeType) -> CodeType:
    """The code object in a module's code that stands where another one stood; raises LookupError."""
    waiting = [code]
    while waiting:
        here = waiting.pop()
        if here.co_qualname == like.co_qualname and here.co_firstlineno == like.co_firstlineno:
            return here
        waiting += [const for const in here.co_consts if isinstance(const, CodeType)]
    raise LookupError(like.co_qualname)


class FunctionMutants:
    """A pytest plugin that, in place of running the collected tests once, runs them on every mutant."""

    def __init__(
        self, modules: Sequence[Module], wanted: Callable[[Mutant], bool], jobs: int, tell: Callable[[Outcome], None]
    ) -> None:
        self._modules, self._wanted, self._jobs, self._tell = modules, wanted, jobs, tell
        self.covered = Covered()
        self.tests: list[str] = []
        self.left: list[Mutant] = []
        """Mutants that need a new import."""
        self.problem = ""
        self._failed = ""
        self._kills: dict[tuple[str, int], int] = {}

    def pytest_sessionstart(self) -> None:
        quiet_profile()

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self._failed:
            self._failed = report.nodeid

    def pytest_runtestloop(self, session: Any) -> bool:
        if session.testsfailed:
            self.problem = "the tests cannot be collected"
            return True
        items = session.items
        self.tests = [item.nodeid for item in items]
        self.covered = self._measure(items)
        forks = Forks(self._jobs)
        for module in self._modules:
            loaded = importlib.import_module(module.name)
            for mutant in module.mutants:
                if not self._wanted(mutant):
                    continue
                function = function_of(loaded, mutant) if mutant.function else None
                if function is None:
                    self.left.append(mutant)
                    continue
                chosen = self._tests_of(module.name, mutant)
                if not chosen:
                    self._tell(Outcome(mutant, SURVIVED, "no test runs it"))
                    continue
                cpu_s = CPU_FACTOR * sum(self.covered.seconds[i] for i in chosen) + CPU_EXTRA_S
                work = self._work(module, mutant, function, [items[i] for i in chosen], chosen)
                self._note(forks.start(mutant, cpu_s, work))
        self._note(forks.finish())
        return True

    def _note(self, ended: Iterator[tuple[Any, int | None, str]]) -> None:
        for mutant, code, words in ended:
            test, _, number = words.rpartition("|")
            if code == 10 and number.isdigit():
                key = (mutant.function, int(number))
                self._kills[key] = self._kills.get(key, 0) + 1
            self._tell(_outcome(mutant, code, test or words))

    def _tests_of(self, name: str, mutant: Mutant) -> list[int]:
        """The tests that run a mutant's lines: first those that killed its neighbours, then the quickest."""
        lines = self.covered.lines.get(name, {})
        seconds = self.covered.seconds
        found = {
            i for at in range(mutant.lines[0], mutant.lines[1] + 1) for i in lines.get(at, ()) if seconds[i] <= LONG_S
        }
        return sorted(found, key=lambda i: (-self._kills.get((mutant.function, i), 0), seconds[i], i))

    def _work(
        self, module: Module, mutant: Mutant, function: FunctionType, items: list[Any], numbers: list[int]
    ) -> Callable[[int], int]:
        def work(pipe: int) -> int:
            function.__code__ = code_within(module.compiled(mutant.number), function.__code__)
            for place, item in enumerate(items):
                after = items[place + 1] if place + 1 < len(items) else None
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                if self._failed:
                    os.write(pipe, f"{self._failed}|{numbers[place]}".encode())
                    return 10
            return 11

        return work

    def _measure(self, items: Sequence[Any]) -> Covered:
        """Run the unchanged tests once, in a child, with a context for each test.

        Raises:
            TestsFail: one of them fails.
        """
        path = Path(os.environ["TIMBERHAND_MUTANTS"])

        def work(pipe: int) -> int:
            from coverage import Coverage

            measured = Coverage(data_file=None, branch=False, include=[str(m.path) for m in self._modules])
            measured.start()
            seconds = []
            for place, item in enumerate(items):
                measured.switch_context(str(place))
                begun = time.process_time()
                after = items[place + 1] if place + 1 < len(items) else None
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                seconds.append(time.process_time() - begun)
                if self._failed:
                    os.write(pipe, self._failed.encode())
                    return 2
            measured.stop()
            data = measured.get_data()
            lines: dict[str, dict[int, list[int]]] = {}
            for module in self._modules:
                contexts = data.contexts_by_lineno(str(module.path))
                lines[module.name] = {at: [int(c) for c in names if c] for at, names in contexts.items()}
            path.write_text(json.dumps({"seconds": seconds, "lines": lines, "tests": [i.nodeid for i in items]}))
            return 11

        kept = json.loads(path.read_text()) if path.exists() else {}
        if kept.get("tests") != [item.nodeid for item in items]:
            forks = Forks(1)
            ended = [*forks.start("baseline", 3600.0, work), *forks.finish()]
            if ended[0][1] != 11:
                raise TestsFail(f"the tests fail without a mutant: {ended[0][2]}")
        found = json.loads(path.read_text())
        lines = {name: {int(at): tests for at, tests in by.items()} for name, by in found["lines"].items()}
        return Covered(lines, found["seconds"])


# -- mutants of a module's own statements ------------------------------------------------------------------------------


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from other code."""

    def __init__(self, name: str, path: Path, code: CodeType) -> None:
        self._name, self._path, self._code = name, path, code
        self.failed = ""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> Any:
        if fullname != self._name:
            return None
        return importlib.util.spec_from_file_location(fullname, self._path, loader=self)

    def create_module(self, spec: Any) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        try:
            exec(self._code, vars(module))
        except BaseException as error:
            self.failed = f"{type(error).__name__}: {error}"
            raise


class _FirstFailure:
    def __init__(self) -> None:
        self.failed = ""

    def pytest_sessionstart(self) -> None:
        quiet_profile()

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid


def run_imported(
    scope: Scope,
    modules: dict[str, Module],
    mutants: Sequence[Mutant],
    baseline: Baseline,
    jobs: int,
    tell: Callable[[Outcome], None],
) -> None:
    """Run mutants that change what an import makes; call it before pytest has collected anything in this process."""
    long = [f"--deselect={name}" for name in baseline.long]
    forks = Forks(jobs)

    def work_on(mutant: Mutant) -> Callable[[int], int]:
        def work(pipe: int) -> int:
            module = modules[mutant.module]
            finder = _Mutated(module.name, module.path, module.compiled(mutant.number))
            for name in [n for n in sys.modules if n.split(".")[0] in PURGED and not n.startswith("tests.mutation")]:
                del sys.modules[name]
            sys.meta_path.insert(0, finder)
            importlib.import_module(module.name)
            for path in scope.tests():  # one after the other: most mutants end in the first file
                seen = _FirstFailure()
                code = int(pytest.main([*PYTEST, *long, str(path)], plugins=[seen]))
                if finder.failed or code not in (0, 5):  # 5: no test of this file is wanted
                    os.write(pipe, (finder.failed or seen.failed or f"pytest ended with {code}").encode())
                    return 10 if code == 1 and not finder.failed else 1
            return 11

        return work

    for mutant in mutants:
        for what, code, words in forks.start(mutant, CPU_FACTOR * baseline.cpu_s + CPU_EXTRA_S, work_on(mutant)):
            tell(_outcome(what, code, words))
    for what, code, words in forks.finish():
        tell(_outcome(what, code, words))


def collect_and_run(
    scope: Scope,
    modules: Sequence[Module],
    wanted: Callable[[Mutant], bool],
    jobs: int,
    tell: Callable[[Outcome], None],
) -> tuple[list[Mutant], Baseline]:
    """Run the mutants in functions; returns those that need an import, and what the unchanged tests need.

    Raises:
        TestsFail: the tests fail without a mutant, or cannot be collected.
    """
    plugin = FunctionMutants(modules, wanted, jobs, tell)
    pytest.main([*PYTEST, *map(str, scope.tests())], plugins=[plugin])
    if plugin.problem:
        raise TestsFail(plugin.problem)
    needed = dict(zip(plugin.tests, plugin.covered.seconds, strict=True))
    long = tuple(name for name, seconds in needed.items() if seconds > LONG_S)
    return plugin.left, Baseline(sum(needed.values()), long)
