"""Mutates supervisor and guard, runs their tests on every mutant, and writes ``docs/results/mutants.json``.

``python -m tests.mutation [--scope supervisor|guard] [--module NAME] [--jobs N] [--list]``, or ``make mutants``.

An interrupted run goes on where it stopped: results are kept in ``build/mutants`` until a source or a test changes.
The score is killed / (killed + survived), time-outs being kills; mutants that `equivalents.toml` explains are left
out, and ``raw`` is the score with them.  Exit codes: 0 every score is at least 0.95, 1 one is lower, 2 usage, 3 the
tests fail without a mutant.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import subprocess
import sys
import time
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

from tests.mutation.mutators import Module, Mutant
from tests.mutation.runner import (
    KILLED,
    SURVIVED,
    TIMEOUT,
    UNUSABLE,
    Baseline,
    Outcome,
    TestsFail,
    collect_and_run,
    run_imported,
)
from tests.safety_scope import ROOT, SCOPES, Scope

WANTED_SCORE = 0.95
KEPT = ROOT / "build" / "mutants"
RESULT = ROOT / "docs" / "results" / "mutants.json"
EQUIVALENTS = Path(__file__).with_name("equivalents.toml")
_WARM = (
    "can_dbc.dbc.codec",
    "can_dbc.messages.datagrams",
    "machine.loading.profile_file",
    "machine.status.faults",
    "numpy",
)
"""Imported once, before the forks: they hold nothing of a mutated module."""


class Kept:
    """Results of earlier runs on the same sources and tests, one line of JSON each."""

    def __init__(self, scope: Scope) -> None:
        digest = hashlib.sha256()
        own = sorted(Path(__file__).parent.glob("*.py"))
        helpers = sorted(ROOT.glob("tests/controller/*.py"))
        for path in (*scope.sources().values(), *scope.tests(), *helpers, *own):
            digest.update(path.read_bytes())
        KEPT.mkdir(parents=True, exist_ok=True)
        self.path = KEPT / f"{scope.name}-{digest.hexdigest()[:16]}.jsonl"

    def read(self) -> dict[tuple[str, int], tuple[str, str]]:
        """(module, number) -> status and words."""
        found = {}
        if self.path.exists():
            for line in self.path.read_text().splitlines():
                entry = json.loads(line)
                found[entry["module"], entry["number"]] = (entry["status"], entry["by"])
        return found

    def add(self, outcome: Outcome) -> None:
        """Append one result."""
        entry = {
            "module": outcome.mutant.module,
            "number": outcome.mutant.number,
            "status": outcome.status,
            "by": outcome.by,
        }
        with self.path.open("a") as file:
            file.write(json.dumps(entry) + "\n")


def run_scope(scope: Scope, modules: dict[str, Module], only: str, jobs: int) -> dict[tuple[str, int], tuple[str, str]]:
    """Run the mutants of one scope that have no result yet; returns all results.

    Raises:
        TestsFail: the tests fail without a mutant.
    """
    kept = Kept(scope)
    before = kept.read()
    begun, done = time.monotonic(), 0
    total = sum(len(m.mutants) for m in modules.values() if not only or m.name == only) - len(before)

    def wanted(mutant: Mutant) -> bool:
        return (mutant.module, mutant.number) not in before and (not only or mutant.module == only)

    def tell(outcome: Outcome) -> None:
        nonlocal done
        kept.add(outcome)
        done += 1
        mutant = outcome.mutant
        if outcome.status != KILLED or done % 50 == 0:
            text = f"{outcome.status:9} {mutant.module}:{mutant.lines[0]} {mutant.change}  [{outcome.by[:120]}]"
            print(f"{done}/{total} {time.monotonic() - begun:.0f} s {text}", flush=True)

    left_path = KEPT / f"{scope.name}.left"
    os.environ["TIMBERHAND_MUTANTS"] = str(kept.path.with_suffix(".baseline"))
    child = os.fork()
    if child == 0:
        code = 3
        try:
            left, baseline = collect_and_run(scope, list(modules.values()), wanted, jobs, tell)
            entry = {"left": [(m.module, m.number) for m in left], "cpu_s": baseline.cpu_s, "long": baseline.long}
            left_path.write_text(json.dumps(entry))
            code = 0
        except TestsFail as error:
            print(f"mutants: {scope.name}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(code)
    if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0:
        raise TestsFail(f"{scope.name}: the tests fail without a mutant")
    found = json.loads(left_path.read_text())
    left = [modules[name].mutants[number] for name, number in found["left"]]
    done = len(kept.read()) - len(before)
    run_imported(scope, modules, left, Baseline(found["cpu_s"], tuple(found["long"])), jobs, tell)
    return kept.read()


def equivalents() -> dict[str, str]:
    """Key of a mutant -> why no test can tell it from the original."""
    if not EQUIVALENTS.exists():
        return {}
    entries = tomllib.loads(EQUIVALENTS.read_text())["mutant"]
    return {entry["key"]: entry["why"] for entry in entries}


def figures(modules: dict[str, Module], results: dict[tuple[str, int], tuple[str, str]]) -> dict[str, Any]:
    """Counts, scores and survivors of one scope."""
    excused = equivalents()
    counts: Counter[str] = Counter()
    survivors, explained, unusable, unknown = [], [], [], 0
    for module in modules.values():
        for mutant in module.mutants:
            status, by = results.get((mutant.module, mutant.number), ("", ""))
            entry = {
                "module": mutant.module,
                "line": mutant.lines[0],
                "function": mutant.function,
                "operator": mutant.operator,
                "change": mutant.change,
            }
            if not status:
                unknown += 1
            elif status == SURVIVED and mutant.key in excused:
                counts["equivalent"] += 1
                explained.append(entry | {"why": excused[mutant.key]})
            else:
                counts[status] += 1
                if status == SURVIVED:
                    survivors.append(entry)
                elif status == UNUSABLE:
                    unusable.append(entry | {"why": by})
    killed = counts[KILLED] + counts[TIMEOUT]
    judged = killed + counts[SURVIVED] + unknown  # one that has not run yet is not killed
    return {
        "score": round(killed / judged, 4) if judged else 0.0,
        "raw": round(killed / (judged + counts["equivalent"]), 4) if judged else 0.0,
        "mutants": sum(len(m.mutants) for m in modules.values()),
        "killed": counts[KILLED],
        "timeouts": counts[TIMEOUT],
        "survived": counts[SURVIVED],
        "equivalent": counts["equivalent"],
        "unusable": counts[UNUSABLE],
        "not_run": unknown,
        "survivors": survivors,
        "equivalents": explained,
        "unusable_mutants": unusable,
    }


def commit() -> str:
    """The commit, with a plus if the work tree differs from it."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()

    dirty = git("status", "--porcelain", "--untracked-files=no", "controller", "tests")
    return git("rev-parse", "--short=12", "HEAD") + ("+" if dirty else "")


def write_result(found: dict[str, dict[str, Any]]) -> None:
    """Write the figures of the scopes that ran, each with its commit; what another run found of the others stays."""
    kept = json.loads(RESULT.read_text())["scopes"] if RESULT.exists() else {}
    scopes = kept | {name: {"commit": commit(), **numbers} for name, numbers in found.items()}
    scores = {name: numbers["score"] for name, numbers in scopes.items()}
    result = {"command": "make mutants", "wanted": WANTED_SCORE, **scores, "scopes": scopes}
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


def main(arguments: list[str] | None = None) -> int:
    """Run, print a table, write the result; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scope", choices=[s.name for s in SCOPES], action="append", help="default: all of them")
    parser.add_argument("--module", default="", help="only the mutants of this module; no result is written")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes side by side")
    parser.add_argument("--list", action="store_true", help="only list the mutants")
    options = parser.parse_args(arguments)
    for name in _WARM:
        importlib.import_module(name)
    found: dict[str, dict[str, Any]] = {}
    for scope in SCOPES:
        if options.scope and scope.name not in options.scope:
            continue
        modules = {name: Module(name, path) for name, path in scope.sources().items()}
        if options.list:
            for mutant in (m for module in modules.values() for m in module.mutants):
                print(f"{mutant.module}:{mutant.lines[0]}: {mutant.operator}: {mutant.change}")
            continue
        try:
            results = run_scope(scope, modules, options.module, options.jobs)
        except TestsFail as error:
            print(f"mutants: {error}; mend them first.", file=sys.stderr)
            return 3
        found[scope.name] = figures(modules, results)
    if options.list:
        return 0
    for name, numbers in found.items():
        print(
            f"{name}: score {numbers['score']:.4f} (raw {numbers['raw']:.4f}); "
            + ", ".join(
                f"{numbers[key]} {key}"
                for key in ("mutants", "killed", "timeouts", "survived", "equivalent", "unusable", "not_run")
            )
        )
    if not options.module:
        write_result(found)
        print(f"written: {RESULT.relative_to(ROOT)}")
    return 0 if all(numbers["score"] >= WANTED_SCORE for numbers in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
