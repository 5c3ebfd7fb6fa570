"""Why an estimate must not be flown on, although there is one."""

from __future__ import annotations

from enum import Enum


class Objection(Enum):
    """The gravest of what speaks against the estimate; values are for the operator."""

    UNSTABLE = "the filter was started anew twice within a minute"
    CONTRADICTED = "measurements do not agree with the estimate"
    RECOVERING = "the filter is recovering from a contradiction"
