"""All parts of a campaign, and how much of each the three sizes run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from companion.errors import ConfigError
from sim_link.campaign.floods import Floods
from sim_link.campaign.fuzz import Fuzzing
from sim_link.campaign.gaps import GapHours
from sim_link.campaign.kills import Kills, Stops
from sim_link.campaign.missions import Missions
from sim_link.campaign.override import Overrides
from sim_link.campaign.reactions import Reactions
from sim_link.campaign.signals import Signals
from sim_link.campaign.soak import Soak
from sim_link.campaign.trial import Part, Trial

ALL: tuple[Part, ...] = (
    Missions(),
    Overrides(),
    GapHours(),
    Kills(),
    Stops(),
    Signals(),
    Floods(),
    Fuzzing(),
    Reactions(),
    Soak(),
)
PARTS: Mapping[str, Part] = {part.name: part for part in ALL}

AMOUNTS: Mapping[str, Mapping[str, float]] = {
    "sample": {
        "missions": 12,
        "override": 20,
        "gaps": 0.01,
        "kill": 6,
        "stop": 6,
        "signal": 2,
        "forged": 10_000,
        "fuzz": 5_000,
        "reaction": 6,
        "soak": 0.02,
    },
    "ci": {
        "missions": 500,
        "override": 2000,
        "gaps": 0.1,
        "kill": 200,
        "stop": 200,
        "signal": 20,
        "forged": 1_000_000,
        "fuzz": 1_000_000,
        "reaction": 100,
        "soak": 0.2,
    },
    "long": {
        "missions": 3000,
        "override": 2000,
        "gaps": 10.0,
        "kill": 400,
        "stop": 400,
        "signal": 200,
        "forged": 10_000_000,
        "fuzz": 10_000_000,
        "reaction": 500,
        "soak": 24.0,
    },
    "release": {
        "missions": 10_000,
        "override": 4000,
        "gaps": 10.0,
        "kill": 1000,
        "stop": 1000,
        "signal": 400,
        "forged": 10_000_000,
        "fuzz": 100_000_000,
        "reaction": 2000,
        "soak": 24.0,
    },
}
"""Missions; take-overs; hours at each loss; kills; stops; signals; frames; cuts; hours."""


def trials_of(size: str, seed: int, only: Sequence[str] = ()) -> list[Trial]:
    """The trials of a campaign, the longest first, so that no process ends long after the others.

    Args:
        size: Its name.
        seed: Of the campaign.
        only: Names of parts; none: all.

    Raises:
        ConfigError: No such part.
    """
    check_parts(only)
    trials = [
        (PARTS[name].cost(trial), trial)
        for name, amount in AMOUNTS[size].items()
        if not only or name in only
        for trial in PARTS[name].trials(amount, seed)
    ]
    trials.sort(key=lambda pair: -pair[0])
    return [trial for _, trial in trials]


def check_parts(names: Sequence[str]) -> None:
    """Refuse a part that does not exist.

    Raises:
        ConfigError: The text names those that do.
    """
    for name in names:
        if name not in PARTS:
            raise ConfigError(f"there is no part {name!r}; there are {', '.join(PARTS)}")


def trial_named(text: str) -> Trial:
    """The trial of `PART:SEED[:SIZE]`; a number alone is a mission's seed.

    Raises:
        ConfigError: It names none.
    """
    words = text.split(":")
    if len(words) == 1:
        words = ["missions", *words]
    check_parts(words[:1])
    try:
        seed = int(words[1])
        size = float(words[2]) if len(words) > 2 else 1.0
    except (ValueError, IndexError):
        raise ConfigError(f"{text!r} is no trial: PART:SEED or PART:SEED:SIZE") from None
    if seed < 0 or not 0.0 < size < float("inf") or len(words) > 3:
        raise ConfigError(f"{text!r} is no trial: PART:SEED or PART:SEED:SIZE")
    return Trial(words[0], seed, size)
