"""Why an estimate must not be flown on, although there is one."""

from __future__ import annotations

from enum import Enum


class Objection(Enum):
    """The gravest of what speaks against the estimate; values are for the operator."""

    RANGE_UNIT = "ranges do not fit the own motion: wrong unit?"
    BEARING_UNIT = "bearings make no sense: wrong unit?"
    UNSTABLE = "the filter was started anew twice within a minute"
    CONTRADICTED = "measurements do not agree with the estimate"
    RECOVERING = "the filter is recovering from a contradiction"
