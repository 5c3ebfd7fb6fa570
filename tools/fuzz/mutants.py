"""Small changes to Python source, each a mutant that a test should notice.

Compared values are exchanged for their neighbours and opposites, operators for others, numbers for
those beside them, signs are reversed, operands, branches and statements left out. Texts,
annotations, decorators, imports and names of types stay as they are.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
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
ARITHMETIC: dict[type[ast.operator], tuple[type[ast.operator], ...]] = {
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,),
    ast.Pow: (ast.Mult,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.BitXor: (ast.BitAnd,),
    ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,),
}
FLAGS = (ast.BitAnd, ast.BitOr, ast.BitXor)
"""Operators that form sets of flags, whose sign cannot matter."""
EXCHANGED_CALLS = {"min": "max", "max": "min", "all": "any", "any": "all"}
SKIPPED_FIELDS = {"annotation", "returns", "decorator_list", "bases"}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change to one module."""

    path: str
    line: int
    place: str
    """The class and function that it is in."""
    before: str
    after: str
    nth: int
    """Number among equal changes in the same place, from 1."""

    @property
    def key(self) -> str:
        """Name of the mutant that does not depend on the rest of the file."""
        return f"{self.path} | {self.place} | {self.before} => {self.after} | {self.nth}"


def changes_of(node: ast.AST) -> Iterator[ast.AST | None]:
    """Yield the replacements of a node; None: its statement is dropped."""
    match node:
        case ast.Compare():
            for index, operator in enumerate(node.ops):
                for other in COMPARISONS[type(operator)]:
                    ops = [*node.ops[:index], other(), *node.ops[index + 1 :]]
                    yield ast.Compare(node.left, ops, node.comparators)
        case ast.BinOp():
            for operation in ARITHMETIC.get(type(node.op), ()):
                yield ast.BinOp(node.left, operation(), node.right)
            if not isinstance(node.op, FLAGS):
                yield ast.UnaryOp(ast.USub(), node)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield node.operand
        case ast.BoolOp():
            yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
            for index in range(len(node.values)):
                rest = node.values[:index] + node.values[index + 1 :]
                yield rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
        case ast.IfExp():
            yield node.body
            yield node.orelse
        case ast.Constant(value=bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(value=(int() | float()) as number):
            yield ast.Constant(number + 1)
            yield ast.Constant(number - 1)
        case ast.Call(func=ast.Name(id=name)) if name in EXCHANGED_CALLS:
            opposite = ast.Name(EXCHANGED_CALLS[name], ast.Load())
            yield ast.Call(opposite, node.args, node.keywords)
        case ast.Call(func=ast.Name(id="abs")):
            yield node.args[0]
        case ast.If() | ast.While():
            for value in (True, False):
                if isinstance(node, ast.While) and value:
                    continue  # never ends
                changed = copy.copy(node)
                changed.test = ast.Constant(value)
                yield changed
        case ast.Return(value=ast.Constant(value=None | False) | None):
            return  # false already
        case ast.Return():
            yield ast.Return(ast.Constant(None))
        case (
            ast.Expr() | ast.Assign() | ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break()
        ):
            yield None


def _is_skipped(node: ast.AST, depth: int) -> bool:
    """Return True for docstrings, imports and names of types."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        return True
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    is_type = isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript | ast.BinOp)
    return is_type and depth == 0 and "[" in ast.unparse(node)


@dataclass(frozen=True, slots=True)
class _Site:
    """Place of a node in its tree."""

    node: ast.AST
    parent: ast.AST
    field: str
    index: int | None
    place: str

    def put(self, node: ast.AST) -> None:
        """Put another node there."""
        if self.index is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.index] = node


def _sites(parent: ast.AST, place: str = "", depth: int = 0) -> Iterator[_Site]:
    for name, value in ast.iter_fields(parent):
        if name in SKIPPED_FIELDS or (name == "keywords" and isinstance(parent, ast.ClassDef)):
            continue
        for index, node in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(node, ast.AST) or _is_skipped(node, depth):
                continue
            own = place
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                own = f"{place}.{node.name}" if place else node.name
            at = index if isinstance(value, list) else None
            yield _Site(node, parent, name, at, own or "module")
            yield from _sites(node, own, depth + 1)


def _text(node: ast.AST | None) -> str:
    """Return the first line of a node's source: of an `if` its condition."""
    return "pass" if node is None else ast.unparse(node).splitlines()[0]


def mutants_of(path: Path, root: Path) -> Iterator[tuple[Mutant, ast.Module]]:
    """Yield every mutant of a module, without those whose source equals an earlier one's.

    Args:
        path: The module.
        root: What its path is named from.
    """
    tree = ast.parse(path.read_text())
    seen, names = {ast.unparse(tree)}, Counter[tuple[str, str, str]]()
    for site in list(_sites(tree)):
        for new in changes_of(site.node):
            site.put(ast.Pass() if new is None else new)
            source, changed = ast.unparse(tree), copy.deepcopy(tree)
            site.put(site.node)
            if source in seen:
                continue
            seen.add(source)
            name = (site.place, _text(site.node), _text(new))
            names[name] += 1
            line = getattr(site.node, "lineno", 0)
            relative = str(path.relative_to(root))
            yield Mutant(relative, line, *name, names[name]), ast.fix_missing_locations(changed)
