"""Flights by ranges alone, and by ranges with the received power as well, in pairs.

Both flights of a pair meet the same emitter, walls, wind and noise: a phone that answers Wi-Fi
round-trip requests, as in the field study. One is configured by the radio's preset, the other also
with the power at 1 m, which is wrong by up to 10 dB. Shadowing stays with the position
like errors of ranges; fading changes from frame to frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from scipy.stats import binom

from companion.errors import ConfigError
from companion.kernel import Vector
from tools.study.field_flights import FieldFlight, flights_of, fly
from tools.study.reporting.study_tables import studies_of
from tools.study.study import FlightRow

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
CELL = ("phone_ftm", "configured", "latched_crossing")
"""Radio, configuration and planner of the field study."""
POWER_AT_1M_DBM = -25.0
"""15 dBm of a phone, and 40 dB of loss over the first metre at 2.4 GHz."""
WRONG_BY_DB = 10.0
"""Half width of the uniform error of that power, dB."""
FADING_SIGMA_DB = 4.0
"""Standard deviation of fading from frame to frame: 3 to 6 dB."""
WORSE_BY_CHANCE = 0.05
"""Largest probability at which the number of worse flights is not explained by chance."""
change = msgspec.structs.replace


@dataclass(frozen=True, slots=True)
class PowerPair:
    """One flight without and with power."""

    without: FlightRow
    with_power: FlightRow


def pair_of(number: int, seed: int) -> tuple[FieldFlight, FieldFlight]:
    """Return the two flights of a number, by ranges alone and with power."""
    [study] = studies_of("field", CONFIGS / "studies")
    if study.flights is None:
        raise ConfigError("the field study has no flights")
    flight = flights_of(study.flights, CONFIGS, number + 1, seed, CELL)[number]
    channel = flight.scenario.channel
    assert channel.loss is not None
    wrong_db = np.random.default_rng((flight.seed, 0xDB)).uniform(-WRONG_BY_DB, WRONG_BY_DB)
    at_half_range_db = 10.0 * channel.loss.exponent * math.log10(channel.loss.half_range_m)
    loss = change(
        channel.loss,
        fading_sigma_db=FADING_SIGMA_DB,
        sensitivity_dbm=POWER_AT_1M_DBM + wrong_db - at_half_range_db,
    )
    scenario = change(flight.scenario, channel=change(channel, loss=loss))
    ranges = replace(flight, scenario=scenario)
    estimation = flight.config.estimation
    powers = change(estimation.filter, power_at_1m_dbm=POWER_AT_1M_DBM)
    config = change(flight.config, estimation=change(estimation, filter=powers))
    return ranges, replace(ranges, config=config)


def fly_both(number: int, seed: int) -> PowerPair:
    """Fly the two flights of a number."""
    without, with_power = (
        msgspec.json.decode(fly(flight), type=FlightRow) for flight in pair_of(number, seed)
    )
    return PowerPair(without, with_power)


def table_of_power(pairs: Sequence[PowerPair]) -> tuple[str, bool]:
    """Return the comparison as text, and True if flights with power are not the worse ones.

    They are worse if more of them have a larger error or a wrong radius than chance explains.
    """
    lines = [f"{len(pairs)} pairs                without    with power  better  worse"]
    both = [(pair.without, pair.with_power) for pair in pairs]
    error_m, r95_m, time_s, reported = (
        np.array([[_known(getattr(row, name)) for row in rows] for rows in both])
        for name in ("error_m", "r95_m", "time_s", "is_reported")
    )
    outside = (error_m > r95_m).astype(float)
    is_met = True
    for name, values, figures in (
        ("error, m", error_m, np.median(error_m, axis=0)),
        ("outside R95", outside, outside.sum(axis=0)),
    ):
        better, worse = (values[:, a] > values[:, b] for a, b in ((0, 1), (1, 0)))
        lines.append(f"{_line(name, figures)}{better.sum():8d}{worse.sum():8d}")
        by_chance = binom.sf(worse.sum() - 1, (better | worse).sum(), 0.5)
        is_met &= bool(by_chance > WORSE_BY_CHANCE)
    lines += [
        _line("R95, m", np.median(r95_m, axis=0)),
        _line("time, s", np.median(time_s, axis=0)),
    ]
    lines.append(_line("reported", reported.sum(axis=0)))
    return "\n".join(lines) + "\n", is_met


def _line(name: str, figures: Vector) -> str:
    return f"{name:16}{figures[0]:12.2f}{figures[1]:14.2f}"


def _known(value: float | None) -> float:
    return math.inf if value is None else float(value)
