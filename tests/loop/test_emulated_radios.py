"""Each radio's own bytes find the emitter as RADIO_RANGING of the same draws does.

In lockstep: what differs is what the format has cut off, and nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.flight_setup import build_endpoint
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import Journal, LinkRole, LinkSpec
from sim_link.autopilot.scenario import Scenario
from sim_link.emulators.catalogue import make_emulator
from tests.loop.emulated_radio import (
    Coarsen,
    EmulatedRadio,
    Stamp,
    as_it_is,
    by_the_vehicle,
    in_degrees,
    in_degrees_about_an_upright,
    in_steps,
    of_a_cell,
    of_a_gateway,
    to_five_degrees,
    without_a_clock,
)
from tests.loop.loop_helpers import Loop
from tests.radio_flights import as_flown, place_name, place_of, sigmas
from tests.radio_formats import ALL, CELLS, FORMAT_OF, LTE_STEP_M, NR_STEP_M, Format

pytestmark = pytest.mark.slow

SEED = 1
CELL_SEEDS = range(1, 11)
FIGURES = os.environ.get("RADIO_FIGURES")
"""A file to which errors, R95s and times are appended, the radio's and RADIO_RANGING's."""
LIMIT_S = 600.0
SHARE = 0.025
"""Of the R95, by which errors and R95s may differ: what rounding within a step comes to."""
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
"""What RADIO_RANGING is rounded to, where another flight comes of the steps.

Of a tag with two axes even a millimetre may decide on which side the vehicle passes."""
UUDF_MS = make_emulator("uudf", SEED).device_ms


def by_the_board(now_s: float) -> int:
    """On the clock of the u-blox board.

    On another one the same times differ in their thirteenth digit. Measurements and ticks come at
    the same times here, so that this decides which of the two was first, and of bearings alone in
    whole degrees comes another path.
    """
    return 1000 * UUDF_MS(now_s)


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


def flown(
    place: str,
    format_: Format | None,
    coarsen: Coarsen = as_it_is,
    stamp: Stamp = by_the_vehicle,
    seed: int = SEED,
) -> tuple[float, float, float]:
    """Error, R95 and time of a flight that localised the emitter, metres and seconds."""
    scenario = place_of(place).scenario
    config = knowing(place_of(place).config, scenario)
    emulator = None if format_ is None else make_emulator(format_.name, seed)
    emitter_id = scenario.emitter.emitter_id

    def make(
        config: CompanionConfig, journal: Journal, links: Sequence[LinkSpec]
    ) -> CompanionEndpoint:
        setup = None
        if format_ is not None:
            setup = format_.setup(emitter_id, **sigmas(format_, scenario))
        return build_endpoint(config, journal, (*links[:-1], LinkSpec(LinkRole.RANGING, setup)))

    radio = EmulatedRadio(scenario, seed, emulator, coarsen, stamp)
    period_s = 1.0 / scenario.payload.rate_hz
    loop = Loop(config, scenario, seed, None, radio, period_s, make)
    loop.run_until(lambda: bool(loop.notes.results), LIMIT_S)
    report = loop.notes.results[0][1]
    assert report.emitter_id == emitter_id
    return loop.error_m, report.estimate.r95_m, loop.now_s


SRSRAN_S = make_emulator("srsran", SEED).device_s


def by_the_metrics(now_s: float) -> int:
    """On the clock of the cell's computer, whose milliseconds are told; for the same reason."""
    return 1000 * round(1000.0 * SRSRAN_S(now_s))


GATEWAY_S = make_emulator("lora_forwarder", SEED).device_s


def by_the_gateway(now_s: float) -> int:
    """On the gateway's microseconds; for the same reason."""
    return round(1e6 * GATEWAY_S(now_s))


STAMPS = {"uudf": by_the_board, "srsran": by_the_metrics, "lora_forwarder": by_the_gateway}
"""Where the last digit of a time makes another flight."""


@cache
def reference(place: str, coarsen: Coarsen, stamp: Stamp) -> tuple[float, float, float]:
    """The same with RADIO_RANGING."""
    return flown(place, None, coarsen, stamp)


@pytest.mark.parametrize(
    "format_", [as_flown(each) for each in ALL], ids=lambda each: str(each.name)
)
def test_every_radio_finds_it_as_radio_ranging_does(format_: Format) -> None:
    place = place_name(format_)
    error_m, r95_m, time_s = flown(place, format_)
    stamp = by_the_vehicle if format_.time_s is not None else without_a_clock
    expected_m, expected_r95_m, expected_s = reference(
        place,
        COARSE.get(format_.name, as_it_is),
        STAMPS.get(format_.name, stamp),
    )
    if format_.name in CELLS:
        assert error_m <= r95_m
    if FIGURES is not None:
        with open(FIGURES, "a", encoding="utf-8") as stream:
            stream.write(
                f"{format_.name} {place} {error_m:.3f} {r95_m:.3f} {time_s:.1f} "
                f"{expected_m:.3f} {expected_r95_m:.3f} {expected_s:.1f}\n"
            )
    assert r95_m == pytest.approx(expected_r95_m, rel=SHARE)
    assert error_m == pytest.approx(expected_m, abs=SHARE * expected_r95_m)
    assert time_s == pytest.approx(expected_s, abs=0.5)


@pytest.mark.campaign
@pytest.mark.parametrize("name", CELLS)
def test_a_cell_whose_ranges_come_in_steps_promises_no_more_than_it_keeps(name: str) -> None:
    """Ten flights: at most one finds no end, no report is beside its R95."""
    format_ = as_flown(FORMAT_OF[name])
    found = []
    for seed in CELL_SEEDS:
        try:
            found.append(flown(place_name(format_), format_, seed=seed)[:2])
        except AssertionError as error:
            if "did not hold within" not in str(error):
                raise  # what is missing at the limit is counted below
    most_m = place_of(place_name(format_)).config.estimation.localised_r95_m
    assert len(found) >= len(CELL_SEEDS) - 1
    assert all(error_m <= r95_m <= most_m for error_m, r95_m in found), found
