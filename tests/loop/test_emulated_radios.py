"""Each radio's own bytes find the emitter as RADIO_RANGING of the same draws does.

In lockstep: what differs is what the format has cut off, and nothing else.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkRole, LinkSpec
from sim_link.autopilot.scenario import Scenario
from sim_link.emulators.catalogue import make_emulator
from tests.loop.emulated_radio import (
    EmulatedRadio,
    Passenger,
    as_it_is,
    in_degrees,
    in_degrees_about_an_upright,
    in_steps,
    of_a_cell,
    of_a_gateway,
    to_five_degrees,
)
from tests.loop.loop_helpers import Loop
from tests.radio_flights import as_flown, setup_name, setup_of, sigmas
from tests.radio_formats import (
    ALL,
    CELLS,
    FORMAT_OF,
    LTE_STEP_M,
    NR_STEP_M,
    ONE_OF_EACH_LINE,
    Format,
)

pytestmark = pytest.mark.slow

SEED = 1
OFTEN = (*ONE_OF_EACH_LINE, *CELLS, "nlink_aoa", "pans", "ble_scan", "lora_forwarder", "sx1280")
"""A radio of each line and decoder; the others are more of the same."""
CELL_SEEDS = range(1, 11)
FIGURES = os.environ.get("RADIO_FIGURES")
"""A file to which errors, R95s and times are appended, the radio's and RADIO_RANGING's."""
LIMIT_S = 600.0
SHARE = 0.025
"""Share of R95 by which errors and R95s may differ, from rounding within a step."""
COARSE = {
    "srsran_4g": of_a_cell(LTE_STEP_M),
    "oai": of_a_cell(NR_STEP_M, is_nearest=True),
    "srsran": of_a_cell(NR_STEP_M, is_cut_off=False),
    "sx1280": in_steps(150.0 / (4.096 * 812.5)),
    "lr11xx": in_steps(1.0),
    "kraken": in_degrees,
    "kraken_suite": in_degrees,
    "kraken_xml": in_degrees,
    "uudf": in_degrees_about_an_upright,
    "silabs_aoa": to_five_degrees,
    "nlink_iot": in_steps(1e-3, 0.01),
    "fira_uci": in_steps(0.01, 1.0 / 128.0),
    "sr150": in_steps(0.01, 1.0 / 128.0),
    "qorvo_cli": in_steps(0.01, 0.01),
    **dict.fromkeys(("lora_forwarder", "chirpstack", "things_stack"), of_a_gateway),
}
"""Rounding of RADIO_RANGING of radios whose steps would make another flight.

Of a tag with two axes even a millimetre may decide on which side the vehicle passes."""


def knowing(config: CompanionConfig, scenario: Scenario) -> CompanionConfig:
    """Return the configuration with the scenario's sigmas: no reported one counts as less."""
    sigma_deg = scenario.payload.antenna.sigma_deg or scenario.channel.bearing_sigma_deg
    filter_params = msgspec.structs.replace(
        config.estimation.filter,
        range_sigma_m=scenario.channel.range_sigma_m,
        bearing_sigma_deg=sigma_deg,
    )
    estimation = msgspec.structs.replace(config.estimation, filter=filter_params)
    return msgspec.structs.replace(config, estimation=estimation)


@dataclass(frozen=True, slots=True)
class Outcome:
    """A report, and the estimate by RADIO_RANGING at its time."""

    error_m: float
    r95_m: float
    time_s: float
    expected_error_m: float
    expected_r95_m: float


def flown(name: str, format_: Format, seed: int = SEED) -> Outcome:
    """Return the outcome of a flight by the radio's bytes."""
    scenario = setup_of(name).scenario
    config = knowing(setup_of(name).config, scenario)

    def make(
        config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        setup = format_.setup(scenario.emitter.emitter_id, **sigmas(format_, scenario))
        return build_endpoint(config, journal, (*links[:-1], LinkSpec(LinkRole.RANGING, setup)))

    passengers: list[Passenger] = []
    radio = EmulatedRadio(
        scenario,
        seed,
        make_emulator(format_.name, seed),
        lambda data, now_s: passengers[0].ranging(data, now_s),
        COARSE.get(format_.name, as_it_is),
        has_clock=format_.time_s is not None,
    )
    period_s = 1.0 / scenario.payload.rate_hz
    loop = Loop(config, scenario, seed, None, radio, period_s, make)
    passengers.append(Passenger(loop.flight, loop.flight.config))
    loop.run_until(lambda: bool(loop.notes.results), LIMIT_S)
    time_s, report = loop.notes.results[0]
    expected = passengers[0].companion.session.estimate
    assert report.emitter_id == scenario.emitter.emitter_id
    assert expected is not None
    errors_m = [
        math.dist(each.position_enu_m, scenario.emitter.position_enu_m)
        for each in (report.estimate, expected)
    ]
    return Outcome(errors_m[0], report.estimate.r95_m, time_s, errors_m[1], expected.r95_m)


@pytest.mark.parametrize(
    "format_",
    [
        pytest.param(as_flown(each), marks=[] if each.name in OFTEN else pytest.mark.campaign)
        for each in ALL
    ],
    ids=lambda each: str(each.name),
)
def test_every_radio_finds_it_as_radio_ranging_does(format_: Format) -> None:
    setup = setup_name(format_)
    found = flown(setup, format_)
    if format_.name in CELLS:
        assert found.error_m <= found.r95_m
    if FIGURES is not None:
        with open(FIGURES, "a", encoding="utf-8") as stream:
            figures = " ".join(f"{value:.3f}" for value in astuple(found))
            stream.write(f"{format_.name} {setup} {figures}\n")
    assert found.r95_m == pytest.approx(found.expected_r95_m, rel=SHARE)
    expected_m = pytest.approx(found.expected_error_m, abs=SHARE * found.expected_r95_m)
    assert found.error_m == expected_m


@pytest.mark.campaign
@pytest.mark.parametrize("name", CELLS)
def test_a_cell_whose_ranges_come_in_steps_promises_no_more_than_it_keeps(name: str) -> None:
    """Ten flights: at most one finds no end, no report misses its R95."""
    format_ = as_flown(FORMAT_OF[name])
    found = []
    for seed in CELL_SEEDS:
        try:
            found.append(flown(setup_name(format_), format_, seed))
        except AssertionError as error:
            if "did not hold within" not in str(error):
                raise  # what is missing at the limit is counted below
    most_m = setup_of(setup_name(format_)).config.estimation.localised_r95_m
    assert len(found) >= len(CELL_SEEDS) - 1
    assert all(each.error_m <= each.r95_m <= most_m for each in found), found
