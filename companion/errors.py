"""The errors of the project, by their cause."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterable
from difflib import get_close_matches

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_NOT_FOUND = 1, 2, 3
"""Exit codes: failed run; bad input or unopened link; search that ended with nothing heard."""


class CompanionError(Exception):
    """Base of every error that the project raises on purpose."""


class ConfigError(CompanionError):
    """A configuration, scenario or data file is wrong; the message names file and key."""


class LinkError(CompanionError):
    """A link cannot be opened (port taken, no such device); the message names it and the cause."""


class LocalProtocolError(CompanionError):
    """The calling code violated the protocol, for example by a setpoint with a NaN."""


def how_to_install(*packages: str) -> str:
    """Return the command that adds packages to the environment that this program runs in.

    It needs no pip in there: the Debian package and pipx have none.
    """
    return f"python3 -m pip --python {shlex.quote(sys.executable)} install {shlex.join(packages)}"


def meant(word: str, words: Iterable[str], cutoff: float = 0.6) -> str:
    """Return the question after an unknown word; empty if no known one is similar enough."""
    near = get_close_matches(word.lower(), words, n=1, cutoff=cutoff)
    return f"; did you mean {near[0]}?" if near else ""


_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
"""Control characters but tab and line feed, those that turn the direction of a line, other ends of
a line, and halves of a character."""


def printable(text: str) -> str:
    """Return a text with the characters escaped that a terminal would obey instead of show."""
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)


_PATH = re.compile(r"^(?P<problem>.*) - at `(?P<path>\$.*)`$", re.DOTALL)
_MISSING_KEY = re.compile(r"^Object missing required field `(?P<key>.*)`$")
_TYPE = re.compile(r"`(?P<names>[a-z]+(?: \| [a-z]+)*)`")
_TYPE_WORDS = {
    **{"float": "a number", "int": "a whole number", "bool": "true or false", "str": "text"},
    **{"array": "a list", "null": "null"},
}
"""Words for msgspec's names of types."""


def located(error: Exception) -> tuple[str, str]:
    """Return the path of the value, `$` for the whole, and the problem of a decoder's error."""
    match = _PATH.match(str(error))
    path, problem = (match["path"], match["problem"]) if match else ("$", str(error))
    missing = _MISSING_KEY.match(problem)
    return (f"{path}.{missing['key']}", "required key is missing") if missing else (path, problem)


def in_words(problem: str, an_object: str = "an object") -> str:
    """Return a problem of `located` with words for the names of types."""
    words = {**_TYPE_WORDS, "object": an_object}
    return _TYPE.sub(
        lambda types: " or ".join(words.get(n, f"`{n}`") for n in types["names"].split(" | ")),
        problem.replace("Expected `", "expected `", 1),
    )


def decoding_problem(error: Exception) -> str:
    """Return a decoder's error as one line in words, behind the path of the value."""
    path, problem = located(error)
    return " ".join(f"{path}: {in_words(problem)}".removeprefix("$: ").split())
