"""All mutants of a module: each differs from it by one small change of its syntax tree.

| operator | change |
|---|---|
| comparison | ``<`` to ``<=`` and ``>=``, ``==`` to ``!=``, ``is`` to ``is not``, ``in`` to ``not in`` and so on |
| boolean | ``and`` to ``or`` and back, one operand left out, ``not`` left out |
| arithmetic | ``+`` to ``-``, ``*`` to ``/``, ``&`` to ``|``, ``<<`` to ``>>``; ``min`` to ``max``, ``any``/``all`` |
| constant | ``True`` to ``False``; an integer plus and minus one; a fraction plus one and half of it |
| branch | the condition of ``if``, ``while``, ``a if c else b`` and of a comprehension is negated; a loop has no turn |
| return | ``return None`` in place of a value |
| deletion | a statement is left out; so is one entry of a table |

An integer from 1000 on is a time in ns, of which one more is below what a clock resolves: twice and half of it instead.
Texts, annotations, decorators, ``__slots__``, imports, the arguments of ``raise`` and the block that starts a process
are left alone.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitOr,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.Pow: ast.Mult,
}
_TWINS = {"min": "max", "max": "min", "any": "all", "all": "any"}
_LARGE = 1000
_DELETED = (ast.Expr, ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Raise, ast.Return, ast.Break, ast.Continue)


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: where it is, of which kind, and in words.

    ``function`` is the qualified name of the outermost function around it, "" for a statement that runs when the module
    is imported.  ``lines`` are those of its statement.  ``number`` counts the mutants of the module.
    """

    module: str
    number: int
    operator: str
    change: str
    function: str
    lines: tuple[int, int]

    @property
    def key(self) -> str:
        """What names the mutant although lines move."""
        return f"{self.module}:{self.function or 'module'}: {self.change}"


@dataclass(slots=True)
class _Change:
    """A change that can be made in the tree and taken back."""

    operator: str
    before: str
    after: str
    make: Callable[[], None]
    undo: Callable[[], None]


class Module:
    """The source of a module and its mutants."""

    def __init__(self, name: str, path: Path) -> None:
        self.name, self.path = name, path
        self.source = path.read_text(encoding="utf-8")
        self._tree = ast.parse(self.source)
        self._changes: list[_Change] = []
        self.mutants: list[Mutant] = []
        seen: dict[str, int] = {}
        for change, statement, function in _changes(self._tree):
            text = f"{change.before} -> {change.after}"
            where = f"{function}: {text}"
            seen[where] = seen.get(where, 0) + 1
            if seen[where] > 1:
                text += f" ({seen[where]})"
            first, last = _header(statement)
            mutant = Mutant(name, len(self.mutants), change.operator, text, function, (first, last))
            self.mutants.append(mutant)
            self._changes.append(change)

    def compiled(self, number: int) -> CodeType:
        """The module's code with one mutant; raises SyntaxError or ValueError if Python refuses it."""
        change = self._changes[number]
        change.make()
        try:
            ast.fix_missing_locations(self._tree)
            return compile(self._tree, str(self.path), "exec", dont_inherit=True)
        finally:
            change.undo()


def _header(statement: ast.stmt) -> tuple[int, int]:
    """First and last line of a statement, of a compound one without its body."""
    body = getattr(statement, "body", None)
    last = statement.end_lineno or statement.lineno
    if isinstance(body, list) and body:
        last = max(statement.lineno, body[0].lineno - 1)
    return statement.lineno, last


def _changes(tree: ast.Module) -> Iterator[tuple[_Change, ast.stmt, str]]:
    yield from _block(tree, "body", "", "", True)


def _block(owner: ast.AST, name: str, function: str, scope: str, top: bool) -> Iterator[tuple[_Change, ast.stmt, str]]:
    """The changes in a list of statements; ``scope`` is the qualified name so far, ``top``: not within a function."""
    block: list[ast.stmt] = getattr(owner, name)
    for at, statement in enumerate(block):
        if _left_alone(statement, at, top):
            continue
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            path = f"{scope}.{statement.name}" if scope else statement.name
            for default in (*statement.args.defaults, *statement.args.kw_defaults):
                if default is not None and top:
                    for change in _expression(default, statement.args):
                        yield change, statement, function
            yield from _block(statement, "body", function or path, f"{path}.<locals>", False)
            continue
        if isinstance(statement, ast.ClassDef):
            path = f"{scope}.{statement.name}" if scope else statement.name
            yield from _block(statement, "body", function, path, top)
            continue
        for change in _statement(block, at, statement, top):
            yield change, statement, function
        for part in ("body", "orelse", "finalbody"):
            if isinstance(getattr(statement, part, None), list):
                yield from _block(statement, part, function, scope, top)
        for handler in getattr(statement, "handlers", ()):
            yield from _block(handler, "body", function, scope, top)
        for case in getattr(statement, "cases", ()):
            yield from _block(case, "body", function, scope, top)


def _left_alone(statement: ast.stmt, at: int, top: bool) -> bool:
    if isinstance(statement, ast.Import | ast.ImportFrom | ast.Pass | ast.Global | ast.Nonlocal):
        return True
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return True  # a docstring
    if isinstance(statement, ast.Assign) and any(_is_name(t, "__slots__", "__all__") for t in statement.targets):
        return True
    starts = isinstance(statement, ast.If) and isinstance(statement.test, ast.Compare)
    return top and starts and _is_name(statement.test.left, "__name__")


def _is_name(node: ast.AST, *names: str) -> bool:
    return isinstance(node, ast.Name) and node.id in names


def _statement(block: list[ast.stmt], at: int, statement: ast.stmt, top: bool) -> Iterator[_Change]:
    if (
        isinstance(statement, _DELETED)
        and not top
        and not (isinstance(statement, ast.AnnAssign) and not statement.value)
    ):
        yield _replaced(block, at, statement, ast.Pass(), "deletion", after="(left out)")
    if isinstance(statement, ast.Return) and statement.value is not None and not _is_none(statement.value):
        yield _field(statement, "value", ast.Constant(None), "return", ast.unparse(statement), "return None")
    if isinstance(statement, ast.For):
        before = f"for ... in {ast.unparse(statement.iter)}"
        yield _field(statement, "iter", ast.Tuple([], ast.Load()), "branch", before, "for ... in ()")
    if isinstance(statement, ast.If | ast.While):
        yield from _negated(statement, "test")
    if isinstance(statement, ast.AugAssign) and type(statement.op) in _ARITHMETIC:
        other = _ARITHMETIC[type(statement.op)]()
        before = ast.unparse(statement)
        yield _field(statement, "op", other, "arithmetic", before, f"with {type(other).__name__}")
    for name, child in ast.iter_fields(statement):
        if name in ("annotation", "body", "orelse", "finalbody", "handlers", "cases", "exc", "cause", "targets"):
            continue
        if name == "target" and not isinstance(statement, ast.AugAssign):
            continue
        for node in child if isinstance(child, list) else [child]:
            if isinstance(node, ast.withitem):
                node = node.context_expr
            if isinstance(node, ast.expr):
                yield from _expression(node, statement)


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def _expression(node: ast.expr, owner: ast.AST) -> Iterator[_Change]:
    """The changes in an expression and below it."""
    place = _place_of(owner, node)
    if isinstance(node, ast.JoinedStr):
        return
    match node:
        case ast.Compare():
            yield from _compared(node)
        case ast.BoolOp():
            yield from _boolean(node, place)
        case ast.UnaryOp(op=ast.Not()):
            yield _placed(place, node, node.operand, "boolean")
        case ast.UnaryOp(op=ast.USub()) if not isinstance(node.operand, ast.Constant):
            yield _placed(place, node, node.operand, "arithmetic")
        case ast.BinOp() if type(node.op) in _ARITHMETIC:
            other = _ARITHMETIC[type(node.op)]()
            after = ast.unparse(ast.BinOp(node.left, other, node.right))
            yield _field(node, "op", other, "arithmetic", ast.unparse(node), after)
        case ast.Constant():
            yield from _constant(node, owner, place)
        case ast.IfExp():
            yield from _negated(node, "test")
        case ast.Call(func=ast.Name(id=name)) if name in _TWINS:
            before = ast.unparse(node)
            after = f"{_TWINS[name]}{before[len(name) :]}"
            yield _field(node.func, "id", _TWINS[name], "arithmetic", before, after)
        case ast.Dict() if len(node.keys) > 3:
            for i, key in enumerate(node.keys):
                yield _entry(node, i, "**" if key is None else ast.unparse(key))
        case ast.Set() if len(node.elts) > 1:
            for i, element in enumerate(node.elts):
                yield _element(node, i, ast.unparse(element))
        case ast.Call(func=ast.Name(id="frozenset"), args=[ast.Tuple() as table]):
            for i, element in enumerate(table.elts):
                yield _element(table, i, ast.unparse(element))
        case _:
            pass
    for name, child in ast.iter_fields(node):
        if name in ("annotation",) or (isinstance(node, ast.Lambda) and name == "args"):
            continue
        for inner in child if isinstance(child, list) else [child]:
            if isinstance(inner, ast.keyword):
                yield from _expression(inner.value, inner)
            elif isinstance(inner, ast.comprehension):
                yield from _comprehension(inner)
            elif isinstance(inner, ast.expr):
                yield from _expression(inner, node)


def _comprehension(node: ast.comprehension) -> Iterator[_Change]:
    yield from _expression(node.iter, node)
    for i, condition in enumerate(node.ifs):
        before = f"if {ast.unparse(condition)}"
        yield _replaced(node.ifs, i, condition, _not(condition), "branch", before=before, after=f"negated {before}")
        yield from _expression(condition, node)


def _compared(node: ast.Compare) -> Iterator[_Change]:
    for i, operator in enumerate(node.ops):
        for other in _COMPARISONS.get(type(operator), ()):
            made = list(node.ops)
            made[i] = other()
            after = ast.unparse(ast.Compare(node.left, made, node.comparators))
            yield _replaced(node.ops, i, operator, made[i], "comparison", before=ast.unparse(node), after=after)


def _boolean(node: ast.BoolOp, place: tuple[object, object]) -> Iterator[_Change]:
    other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    before = ast.unparse(node)
    yield _field(node, "op", other, "boolean", before, ast.unparse(ast.BoolOp(other, node.values)))
    for i in range(len(node.values)):
        rest = [value for k, value in enumerate(node.values) if k != i]
        yield _placed(place, node, rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest), "boolean")


def _constant(node: ast.Constant, owner: ast.AST, place: tuple[object, object]) -> Iterator[_Change]:
    value = node.value
    others: tuple[object, ...] = ()
    if isinstance(value, bool):
        others = (not value,)
    elif isinstance(value, int):
        others = (value * 2, value // 2) if abs(value) >= _LARGE else (value + 1, value - 1)
    elif isinstance(value, float):
        others = (value + 1.0, value / 2.0) if value else (1.0, -1.0)
    context = ast.unparse(owner) if not isinstance(owner, ast.stmt | ast.arguments) else ast.unparse(owner)[:120]
    context = context.splitlines()[0]
    for other in others:
        yield _field(node, "value", other, "constant", f"{value!r} in {context}", repr(other))


def _negated(owner: ast.AST, name: str) -> Iterator[_Change]:
    test: ast.expr = getattr(owner, name)
    before = f"if {ast.unparse(test)}"
    yield _field(owner, name, _not(test), "branch", before, f"if not ({ast.unparse(test)})")


def _not(node: ast.expr) -> ast.expr:
    return ast.copy_location(ast.UnaryOp(ast.Not(), node), node)


def _entry(node: ast.Dict, at: int, key: str) -> _Change:
    keys, values = list(node.keys), list(node.values)

    def make() -> None:
        del node.keys[at], node.values[at]

    def undo() -> None:
        node.keys[:], node.values[:] = keys, values

    return _Change("deletion", f"entry {key}", "(left out)", make, undo)


def _element(node: ast.Set | ast.Tuple, at: int, text: str) -> _Change:
    elements = list(node.elts)

    def make() -> None:
        del node.elts[at]

    def undo() -> None:
        node.elts[:] = elements

    return _Change("deletion", f"element {text}", "(left out)", make, undo)


def _place_of(owner: ast.AST, node: ast.expr) -> tuple[object, object]:
    """Where a node hangs: (owner, field) or (list, index)."""
    for name, child in ast.iter_fields(owner):
        if child is node:
            return owner, name
        if isinstance(child, list):
            for i, inner in enumerate(child):
                if inner is node:
                    return child, i
                if isinstance(inner, ast.withitem) and inner.context_expr is node:
                    return inner, "context_expr"
    raise AssertionError(f"{ast.dump(node)} does not hang on {ast.dump(owner)}")


def _placed(place: tuple[object, object], node: ast.expr, other: ast.expr, operator: str) -> _Change:
    owner, at = place
    if isinstance(owner, list):
        assert isinstance(at, int)
        return _replaced(owner, at, node, other, operator)
    assert isinstance(owner, ast.AST) and isinstance(at, str)
    return _field(owner, at, other, operator, ast.unparse(node), ast.unparse(other))


def _replaced(
    owner: list, at: int, node: ast.AST, other: ast.AST, operator: str, before: str = "", after: str = ""
) -> _Change:
    if hasattr(node, "lineno"):
        ast.copy_location(other, node)

    def make() -> None:
        owner[at] = other

    def undo() -> None:
        owner[at] = node

    before = before or ast.unparse(node).splitlines()[0]
    return _Change(operator, before, after or ast.unparse(other), make, undo)


def _field(owner: ast.AST, name: str, other: object, operator: str, before: str, after: str) -> _Change:
    value = getattr(owner, name)
    if isinstance(other, ast.AST) and hasattr(value, "lineno"):
        ast.copy_location(other, value)

    def make() -> None:
        setattr(owner, name, other)

    def undo() -> None:
        setattr(owner, name, value)

    return _Change(operator, before, after, make, undo)
