"""Coverage and end of a search without contact, and that contact changes nothing."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import pytest

from companion.config.schema import CompanionConfig, LimitsConfig, PatternConfig, PlannerConfig
from companion.domain import FlightMode
from companion.estimation.filters.target_filter import FilterParams
from companion.estimation.tracker_params import EstimationConfig
from companion.guidance.commands import SessionParams
from companion.guidance.phases import Phase
from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_target_estimate_message, mavlink
from companion.run import is_handed_over
from companion.search.detection_model import DetectionModel, DetectionParams
from companion.search.searched_flight import SearchAreaParams
from companion.view.snapshot import searched_text
from sim_link.autopilot.scenario import PayloadParams, Scenario
from sim_link.world.environment import EmitterParams
from tests.loop.loop_helpers import Loop, flown_once

FENCE = ((-5.0, -5.0), (65.0, -5.0), (65.0, 65.0), (-5.0, 65.0))
DETECTION = DetectionModel(reach_m=30.0, reach_sigma_db=3.0)


def flown(
    search: SearchAreaParams,
    reach_m: float = 1.0,
    estimation: EstimationConfig = EstimationConfig(),  # noqa: B008
    **limits: float,
) -> Loop:
    """A search by one companion of a vehicle whose radio reaches so far."""
    config = CompanionConfig(
        mission=SessionParams(engage="auto", on_localised="land"),
        limits=LimitsConfig(fence_enu_m=FENCE, **limits),  # type: ignore[arg-type]
        planner=PlannerConfig(search="lawnmower", pattern=PatternConfig(spacing_m=25.0)),
        search=search,
        estimation=estimation,
    )
    emitter = EmitterParams(position_enu_m=(50.0, 50.0))
    return Loop(
        config, Scenario(emitter=emitter, payload=PayloadParams(rate_hz=4.0, max_range_m=reach_m))
    )


@flown_once
def searched() -> Loop:
    """A search that is over at a POS of one half."""
    loop = flown(SearchAreaParams(detection=DETECTION, stop_pos=0.5))
    loop.run_until(lambda: loop.companion.session.is_search_over, 120.0)
    return loop


def test_a_search_ends_at_its_pos_and_says_what_it_searched() -> None:
    loop = searched()
    assert loop.phase is Phase.FINISHED
    assert loop.said("SEARCH OVER, nothing heard: POS ")
    assert loop.said("Nothing heard. The radio sent nothing at all")
    loop.run_until(lambda: loop.companion.session.vehicle.mode is FlightMode.LAND, 10.0)
    loop.run_until(lambda: loop.phase is Phase.YIELD, 30.0)
    assert is_handed_over(loop.companion)  # though the landing has ended the phase of the report
    searching = loop.companion.session.searching
    assert searching.contact_s is None
    flight = searching.flight(0.0)
    assert flight is not None
    assert len(flight.track) > 3
    assert flight.looks


def test_ground_stations_have_the_searched_area_and_no_target() -> None:
    loop = flown(SearchAreaParams(detection=DETECTION, stop_pos=0.85))
    loop.run_until(lambda: loop.companion.session.is_search_over, 120.0)
    loop.run(3.0)
    values: dict[str, list[float]] = {}
    for message in MavCodec(9, 9).decode(bytes(loop.companion_bytes)):
        assert not isinstance(message, MAVLink_target_estimate_message)
        if isinstance(message, mavlink.MAVLink_named_value_float_message):
            values.setdefault(message.name, []).append(message.value)
    assert set(values) == {"SRCH_POS", "SRCH_SHARE"}
    pos, state = values["SRCH_POS"], loop.companion.session.searching.state
    assert state is not None
    assert pos == sorted(pos)
    assert len(pos) > 6
    assert pos[-1] == pytest.approx(state.pos, abs=1e-6)
    assert pos[-1] >= 0.85 > 0.7 > pos[0]
    assert values["SRCH_SHARE"][-1] == pytest.approx(state.share_at(0.8), abs=1e-6)


def test_the_reach_of_the_preset_counts_and_is_named() -> None:
    search = SearchAreaParams(detection=DetectionParams(), stop_pos=0.3)
    loop = flown(search, estimation=EstimationConfig(filter=FilterParams(reach_m=30.0)))
    loop.run_until(lambda: loop.companion.session.is_search_over, 120.0)
    assert loop.said("Reach 30 m, from the radio's preset.")
    flight = loop.companion.session.searching.flight(0.0)
    assert flight is not None
    assert flight.reach_from == "preset"


def test_a_search_ends_when_its_area_is_done_without_any_reach() -> None:
    loop = flown(SearchAreaParams(stop_sweeps=1))
    loop.run_until(lambda: loop.companion.session.is_search_over, 200.0)
    assert loop.said("SEARCH OVER, nothing heard: the area is done")
    assert loop.companion.session.searching.state is None


def test_a_search_ends_where_the_charge_is_for_the_way_home() -> None:
    loop = flown(
        SearchAreaParams(detection=DETECTION), battery_pct_per_km=900.0, battery_reserve_pct=60.0
    )
    loop.run_until(lambda: loop.companion.session.is_search_over, 200.0)
    assert loop.said("SEARCH OVER, nothing heard: remaining charge is for the way home")


def test_contact_ends_the_count_and_the_flight_is_as_without_it() -> None:
    """The same setpoints and estimates with a searched area as without one."""
    with_area = flown(SearchAreaParams(detection=DETECTION), reach_m=30.0)
    without = flown(SearchAreaParams(), reach_m=30.0)
    for loop in (with_area, without):
        loop.run_until(lambda: bool(loop.notes.results), 240.0)  # noqa: B023
    searching = with_area.companion.session.searching
    assert searching.contact_s is not None
    flight = searching.flight(0.0)
    assert flight is not None
    assert flight.contact_unix_s is not None
    assert flight.ended_unix_s <= flight.contact_unix_s
    assert flight.learnt is not None  # from the position of the report
    assert flight.learnt.reach_sigma_db < DETECTION.reach_sigma_db
    assert [s.position_enu_m for s in with_area.setpoints] == [
        s.position_enu_m for s in without.setpoints
    ]
    assert not with_area.companion.session.is_search_over


def test_what_is_heard_at_once_was_no_search() -> None:
    loop = flown(SearchAreaParams(detection=DETECTION), reach_m=500.0)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(10.0)
    assert loop.companion.session.searching.flight(0.0) is None


@pytest.mark.parametrize(
    ("east_deg", "expected"),
    [
        (0.01, "no searched area: the search area lies entirely outside the fence"),
        (0.0, "50 % of the search area's probability is outside the fence"),
    ],
)
def test_an_area_outside_the_fence_is_said_once_and_on_the_ground(
    east_deg: float, expected: str, tmp_path: Path
) -> None:
    origin, side = Scenario().origin, 65.0 / 111_195.0
    wide = 2.0 * side / math.cos(math.radians(origin.latitude_deg))
    west, south = origin.longitude_deg + east_deg, origin.latitude_deg
    ring = [[west, south], [west + wide, south], [west + wide, south + side], [west, south + side]]
    path = tmp_path / "poa.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    loop = flown(SearchAreaParams(detection=DETECTION, area_file=str(path)))
    loop.run_until(lambda: loop.said(expected[:20]), 20.0)
    assert loop.companion.session.searching.listened_s == 0.0  # on the ground
    loop.run(30.0)
    said = [text for _, text in loop.notes.texts if "search area" in text]
    assert said == [expected]


def test_a_replayed_record_states_the_same() -> None:
    """`searched_area.json` alone gives the figures of the flight."""
    from companion.search.searched_flight import SearchedFlight, combined_area

    searching = searched().companion.session.searching
    searching.finish()
    flight, state = searching.flight(0.0), searching.state
    assert flight is not None
    assert state is not None
    read = msgspec.json.decode(msgspec.json.encode(flight), type=SearchedFlight)
    again = combined_area([read])
    assert again is not None
    assert again.pos == pytest.approx(state.pos, abs=0.005)


def test_a_view_shows_how_much_is_searched_and_changes_nothing_in_the_flight() -> None:
    """Also where the planner flies by the same map; after contact there is nothing to show."""
    search = SearchAreaParams(detection=DETECTION, stop_pos=0.6)
    watched, alone = flown(search), flown(search)
    shown: set[str | None] = set()
    for loop in (watched, alone):
        for _ in range(300):
            if loop is watched:
                shown.add(searched_text(loop.companion.session))
            loop.run(0.2)
    assert None in shown  # on the ground
    assert any(text is not None and text.startswith("POS ") for text in shown)
    assert watched.companion.session.is_search_over
    assert [s.position_enu_m for s in watched.setpoints] == [
        s.position_enu_m for s in alone.setpoints
    ]


def test_a_planner_by_probability_finds_what_is_heard_on_the_way() -> None:
    config = CompanionConfig(
        mission=SessionParams(engage="auto"),
        limits=LimitsConfig(fence_enu_m=FENCE),
        planner=PlannerConfig(search="probability", pattern=PatternConfig(spacing_m=25.0)),
        search=SearchAreaParams(detection=DETECTION),
    )
    emitter = EmitterParams(position_enu_m=(50.0, 50.0))
    payload = PayloadParams(max_range_m=30.0)
    loop = Loop(config, Scenario(emitter=emitter, payload=payload))
    loop.run_until(lambda: bool(loop.notes.results), 300.0)
    assert loop.notes.results[0][1].estimate.position_enu_m == pytest.approx((50.0, 50.0), abs=3.0)
