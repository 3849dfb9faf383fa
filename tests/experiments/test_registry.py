"""The sources on which a result depends are those that its experiment imports."""

from __future__ import annotations

import grimp
import pytest

from experiments.common.registry import EXPERIMENTS
from experiments.common.result import ROOT

MEASURED = ("machine", "sim", "can_dbc", "autonomy", "controller", "hil", "training")
"""The packages whose change may change a figure; the others write pages, run processes and keep records."""


@pytest.fixture(scope="module")
def imports() -> grimp.ImportGraph:
    return grimp.build_graph("experiments", *MEASURED, exclude_type_checking_imports=True, cache_dir=None)


def is_on(module: str, source: str) -> bool:
    path = module.replace(".", "/")
    return path == source.removesuffix(".py") or path.startswith(f"{source}/")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_module_that_an_experiment_imports_is_a_source(imports: grimp.ImportGraph, name: str) -> None:
    """A result whose sources miss one would be called current after it changed."""
    entry = EXPERIMENTS[name]
    imported = {m for m in imports.find_upstream_modules(entry.module) if m.split(".")[0] in MEASURED and "." in m}
    assert not sorted(m for m in imported if not any(is_on(m, source) for source in entry.sources))


@pytest.mark.parametrize("name", [name for name, entry in EXPERIMENTS.items() if not entry.live])
def test_every_source_is_imported(imports: grimp.ImportGraph, name: str) -> None:
    """One that is not would call the result stale for nothing.  A live experiment starts processes."""
    entry = EXPERIMENTS[name]
    imported = {entry.module, *imports.find_upstream_modules(entry.module)}
    code = [source for source in entry.sources if any((ROOT / source).rglob("*.py")) or source.endswith(".py")]
    assert not [source for source in code if not any(is_on(m, source) for m in imported)]
