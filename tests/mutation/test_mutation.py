"""The mutator: which mutants it makes, that they differ, and that a kill is a kill."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from tests.mutation.__main__ import equivalents
from tests.mutation.mutators import Module
from tests.mutation.runner import code_within, function_of
from tests.safety_scope import SCOPES

SOURCE = '''
"""A module."""
from enum import IntEnum
LIMIT: int = 3
WAIT_NS = 5_000_000
TABLE = {(1, "a"): 2, (2, "a"): 3, (3, "a"): 4, (4, "a"): 5}
KNOWN = frozenset((1, 2))


class Colour(IntEnum):
    """Two."""

    RED = 0
    BLUE = 1


class Thing:
    __slots__ = ("value",)

    def __init__(self, value: int = 7) -> None:
        self.value = value

    @property
    def large(self) -> bool:
        """Whether it is large."""
        return self.value > LIMIT and not self.value == 11

    def grow(self, by: float) -> int:
        total = 0
        for _ in range(2):
            total += min(self.value, 4) if by >= 0.5 else -self.value
        if total < 0 or by is None:
            raise ValueError(f"too small by {total + 1}")
        return total << 1
'''


@pytest.fixture
def module(tmp_path: Path) -> Module:
    path = tmp_path / "small.py"
    path.write_text(SOURCE)
    return Module("small", path)


def test_every_operator_makes_mutants_and_texts_are_left_alone(module: Module) -> None:
    assert {m.operator for m in module.mutants} == {
        "comparison",
        "boolean",
        "arithmetic",
        "constant",
        "branch",
        "return",
        "deletion",
    }
    changes = [m.change for m in module.mutants]
    for wanted in (
        "self.value > LIMIT -> self.value >= LIMIT",
        "by >= 0.5 -> by > 0.5",
        "by is None -> by is not None",
        "3 in LIMIT: int = 3 -> 4",
        "5000000 in WAIT_NS = 5000000 -> 10000000",
        "entry (2, 'a') -> (left out)",
        "element 2 -> (left out)",
        "return total << 1 -> return None",
        "total << 1 -> total >> 1",
        "min(self.value, 4) -> max(self.value, 4)",
        "1 in BLUE = 1 -> 2",
        "for ... in range(2) -> for ... in ()",
        "if total < 0 or by is None -> if not (total < 0 or by is None)",
    ):
        assert wanted in changes, wanted
    assert not any("module" in c or "slots" in c or "too small" in c.split(" -> ")[1] for c in changes)
    assert len({m.key for m in module.mutants}) == len(module.mutants)


def test_every_mutant_compiles_to_other_code_and_leaves_the_tree_as_it_was(module: Module) -> None:
    original = compile(SOURCE, str(module.path), "exec")
    for mutant in module.mutants:
        made = module.compiled(mutant.number)
        assert _everything(made) != _everything(original), mutant
    assert [m.change for m in Module("small", module.path).mutants] == [m.change for m in module.mutants]


def _everything(code) -> list:
    inner = [_everything(c) if hasattr(c, "co_code") else repr(c) for c in code.co_consts]
    return [code.co_code, inner, code.co_names, code.co_exceptiontable]


def test_a_mutant_of_a_method_or_property_changes_the_loaded_class(module: Module) -> None:
    loaded = ModuleType("small")
    exec(compile(SOURCE, str(module.path), "exec"), vars(loaded))
    wanted = next(m for m in module.mutants if m.change == "self.value > LIMIT -> self.value <= LIMIT")
    assert wanted.function == "Thing.large"
    function = function_of(loaded, wanted)
    assert function is not None and loaded.Thing(9).large
    function.__code__ = code_within(module.compiled(wanted.number), function.__code__)
    assert not loaded.Thing(9).large and loaded.Thing(2).large
    outside = next(m for m in module.mutants if m.change.startswith("3 in LIMIT"))
    assert outside.function == ""


def test_every_excused_mutant_exists_and_has_a_reason() -> None:
    """An excuse for a mutant that no longer exists must go."""
    keys = {m.key for scope in SCOPES for name, path in scope.sources().items() for m in Module(name, path).mutants}
    excused = equivalents()
    assert set(excused) <= keys, set(excused) - keys
    assert all(len(why) > 20 for why in excused.values())
