"""The lists of operator messages against the source: neither has a text that the other lacks."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import companion
from companion.guard.gate import GuardReason
from companion.guidance.control_authority import Reason
from companion.guidance.messages import SILENT

GUIDANCE = Path(companion.__file__).parent / "guidance"
DOCS = Path(__file__).parents[4] / "docs"
SPEAKERS = {"announce", "warn", "Announce", "Finding", "_finding"}
"""Functions that are called with a text for the operator."""
BEYOND = ("link", "diagnostics.py", "persistence.py", "run.py")
"""Modules with texts outside of the session: by `SPEAKERS` and by these, or put on a list."""
SPEAKERS_BEYOND = SPEAKERS | {"text", "_announce", "ProcessMessage"}
LISTS = {"texts", "news"}
FAILURES = {"failure", "refusal", "note"}
"""Attributes whose text becomes part of one."""
UNWORDED = (Reason.NO_LINK, Reason.MODE_UNKNOWN, Reason.POSITION_STALE, Reason.NO_HOME)
"""Recognised by their names."""
BLANK = "…"
"""Pattern of a value that a text fills in."""


def texts_of(expression: ast.expr, function: ast.AST) -> Iterator[str]:
    """Yield all texts of an expression, with blanks for what is filled in."""
    match expression:
        case ast.Constant(value=str(text)):
            yield text
        case ast.JoinedStr(values=parts):
            yield "".join(
                str(part.value) if isinstance(part, ast.Constant) else BLANK for part in parts
            )
        case ast.IfExp(body=body, orelse=orelse):
            yield from texts_of(body, function)
            yield from texts_of(orelse, function)
        case ast.Name(id=name):
            for node in ast.walk(function):
                if isinstance(node, ast.Assign | ast.AugAssign):
                    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                    if any(isinstance(each, ast.Name) and each.id == name for each in targets):
                        yield from texts_of(node.value, function)


def said_in(module: ast.Module, speakers: set[str] = SPEAKERS) -> Iterator[str]:
    """Every text for the operator in a module."""
    for function in ast.walk(module):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and called(node) in speakers:
                is_state = called(node) == "Announce" and len(node.args) > 2
                for argument in node.args[:-1] if is_state else node.args:
                    yield from texts_of(argument, function)
            if isinstance(node, ast.Assign) and any(
                isinstance(target, ast.Attribute) and target.attr in FAILURES
                for target in node.targets
            ):
                yield from texts_of(node.value, function)


def said_beyond(module: ast.Module) -> Iterator[str]:
    """Those, and texts that a function lists for others to say, alone or with their severity."""
    yield from said_in(module, SPEAKERS_BEYOND)
    for function in ast.walk(module):
        if not isinstance(function, ast.FunctionDef):
            continue
        for node in ast.walk(function):
            match node:
                case ast.Tuple(elts=[ast.Attribute(value=ast.Name(id="Severity")), text]):
                    yield from texts_of(text, function)
                case ast.Call(
                    func=ast.Attribute(value=ast.Name(id=name), attr="append"), args=[text]
                ) if name in LISTS:
                    yield from texts_of(text, function)


def called(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def listed() -> set[str]:
    """The texts of both pages: the codes in the first column of the tables of messages, and in
    the second one of failures.
    """
    rows = re.findall(r"^\| (`.*?`) \|", (DOCS / "messages.md").read_text(), re.MULTILINE)
    failures = (DOCS / "safety.md").read_text()
    rows += re.findall(r"^\| [^|]+ \| (`[^`]+`) \|", failures, re.MULTILINE)
    return {text for row in rows for text in row.strip("`").split("`, `")}


def sources(*folders: str) -> list[ast.Module]:
    root = GUIDANCE.parent
    paths = [path for folder in folders for path in sorted(root.glob(f"{folder}/**/*.py"))]
    paths += [root / folder for folder in folders if folder.endswith(".py")]
    return [ast.parse(path.read_text()) for path in paths]


def test_every_text_of_the_session_is_listed() -> None:
    said = {text for module in sources("guidance") for text in said_in(module)}
    said |= {f"{reason.value}" for reason in GuardReason if reason not in SILENT}
    said |= {reason.value for reason in UNWORDED}
    assert unlisted(said) == []


def test_every_text_of_link_and_process_is_listed() -> None:
    """A text of a radio's battery, say, has a row as one of the vehicle's has."""
    assert unlisted({text for module in sources(*BEYOND) for text in said_beyond(module)}) == []


def unlisted(said: set[str]) -> list[str]:
    """The texts without a row in docs/messages.md or docs/safety.md: each belongs into a table."""
    return sorted({text for text in said if re.search(r"\w", text)} - listed())


def test_no_text_is_listed_that_is_never_announced() -> None:
    constants = {
        node.value
        for module in sources("guidance", "guard", "domain.py", *BEYOND)
        for node in ast.walk(module)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    for text in listed():
        for words in filter(None, re.split(f"{BLANK}(?:: )?", text)):
            assert any(words in constant for constant in constants), text
