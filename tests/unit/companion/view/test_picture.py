"""The picture of a moment that views receive."""

import json
import math
from typing import Any

import msgspec
import pytest

from companion.config.schema import CompanionConfig
from companion.estimation.antenna import AntennaKind, AntennaParams
from companion.guidance.commands import SessionParams
from companion.io.files import plain
from companion.view.snapshot import picture_of, scene_of
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep import Flight, MemoryJournal

CONFIG = CompanionConfig(mission=SessionParams(engage="auto"))


def test_an_autopilot_is_lost_only_if_it_was_heard() -> None:
    flight = Flight(CONFIG, Scenario(), 1, MemoryJournal())
    companion = flight.companion
    assert companion is not None
    assert picture_of(companion, 0.0)["is_link_lost"] is False
    flight.run(5.0)  # three seconds until the only autopilot is bound
    assert picture_of(companion, flight.now_s)["is_link_lost"] is False
    assert picture_of(companion, flight.now_s + 10.0)["is_link_lost"] is True


def test_a_picture_goes_into_json_and_stays_small() -> None:
    flight = Flight(CONFIG, Scenario(), 1, MemoryJournal())
    flight.run(20.0)
    assert flight.companion is not None
    picture = {**scene_of(CONFIG), **picture_of(flight.companion, flight.now_s)}
    assert len(json.dumps(plain(picture), allow_nan=False)) < 8000
    estimate = flight.companion.session.estimate
    assert estimate is not None
    drawn = picture["estimate"]
    assert isinstance(drawn, dict)
    assert (drawn["r95_m"], drawn["absolute_r95_m"]) == (estimate.r95_m, estimate.absolute_r95_m)
    assert drawn["own_text"] == "GNSS 0.02 m"
    assert picture["phase_detail"] == "approach: crossing 1, 19.1 m beyond the estimate"


def antenna_view(mount_deg: tuple[float, float, float], kind: AntennaKind) -> dict[str, Any]:
    """Return the picture of an antenna with a view of 120 degrees, in the first seconds."""
    antenna = AntennaParams(kind=kind, mount_deg=mount_deg, field_of_view_deg=120.0)
    change = msgspec.structs.replace
    believed = change(CONFIG.estimation.filter, antenna=antenna)
    config = change(CONFIG, estimation=change(CONFIG.estimation, filter=believed))
    flight = Flight(config, Scenario(), 1, MemoryJournal())
    flight.run(7.0)
    picture = picture_of(flight.companion, flight.now_s)
    east, north, up = flight.companion.session.vehicle.track.latest.position_enu_m  # type: ignore[union-attr]
    view = picture["antenna"]
    assert isinstance(view, dict)
    assert scene_of(config)["has_antenna"] is True
    return {**view, "vehicle": (east, north), "height_m": up}


def test_an_antenna_that_looks_down_sees_a_disc_below_the_vehicle() -> None:
    view = antenna_view((0.0, -90.0, 0.0), "two_axis")
    radii = [math.dist(view["vehicle"], corner) for corner in view["outline"]]
    assert sum(radii) / len(radii) == pytest.approx(
        min(60.0, view["height_m"] * math.tan(math.radians(60.0))), rel=0.2
    )
    assert math.dist(view["vehicle"], view["ahead"]) < 0.3 * view["height_m"]


def test_an_antenna_that_looks_ahead_sees_a_sector_and_nothing_behind() -> None:
    view = antenna_view((0.0, 0.0, 0.0), "line")
    east, north = view["vehicle"]
    ahead = (view["ahead"][0] - east, view["ahead"][1] - north)
    for corner in view["outline"]:
        way = (corner[0] - east, corner[1] - north)
        assert math.hypot(*way) <= 60.0 + 1e-6
        assert ahead[0] * way[0] + ahead[1] * way[1] > 0.0


def test_an_azimuth_about_the_vertical_has_no_view_to_draw() -> None:
    flight = Flight(CONFIG, Scenario(), 1, MemoryJournal())
    flight.run(5.0)
    assert picture_of(flight.companion, flight.now_s)["antenna"] is None
