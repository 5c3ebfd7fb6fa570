"""Modules that may write the context that the parts of a session share."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import companion
from companion.guidance.context import SessionContext

PRODUCT = Path(companion.__file__).parent
OWNER = PRODUCT / "guidance" / "context.py"
NAMES = ("context", "_context")


def is_context(node: ast.expr) -> bool:
    """Return True if an expression is a session's context, by the name that all modules use."""
    return (isinstance(node, ast.Name) and node.id in NAMES) or (
        isinstance(node, ast.Attribute) and node.attr in NAMES
    )


def written_attributes(source: str) -> Iterator[str]:
    """Attributes of a context that are assigned, augmented or deleted, and private ones used."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and is_context(node.value):
            is_written = isinstance(node.ctx, ast.Store | ast.Del)
            if is_written or node.attr.startswith("_"):
                yield f"{node.attr} in line {node.lineno}"


def test_only_the_context_writes_its_attributes() -> None:
    written = {
        str(path.relative_to(PRODUCT)): names
        for path in PRODUCT.rglob("*.py")
        if path != OWNER and (names := list(written_attributes(path.read_text())))
    }
    assert written == {}


def test_all_of_guidance_calls_a_context_by_that_name() -> None:
    for path in (PRODUCT / "guidance").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.arg) and node.annotation is not None:
                is_one = ast.unparse(node.annotation) == SessionContext.__name__
                assert not is_one or node.arg == "context", path


@pytest.mark.parametrize(
    "line",
    [
        "context.estimate = None",
        "self._context.launch = None",
        "session.context.has_launched, x = True, 1",
        "context.reasons += 1",
        "del context.finding",
        "context._commands.append(1)",
    ],
)
def test_every_way_to_write_one_is_seen(line: str) -> None:
    assert list(written_attributes(line))
