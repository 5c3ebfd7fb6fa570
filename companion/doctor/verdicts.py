"""The doctor's findings as values."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """How bad it is."""

    OK = "OK"
    WARN = "WARN"
    """It flies, but not as well, or not as safely, as it could."""
    FAIL = "FAIL"
    """Do not fly like this."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line."""

    level: Level
    subject: str
    text: str
    """What was found."""
    fix: str = ""
    """What mends it."""


def ok(subject: str, text: str) -> Finding:
    """Nothing to mend."""
    return Finding(Level.OK, subject, text)


def warn(subject: str, text: str, fix: str) -> Finding:
    """Something to mend."""
    return Finding(Level.WARN, subject, text, fix)


def fail(subject: str, text: str, fix: str) -> Finding:
    """Something to mend before any flight."""
    return Finding(Level.FAIL, subject, text, fix)
