"""What views are told of a moment."""

import json

from companion.config.schema import CompanionConfig
from companion.guidance.session_params import SessionParams
from companion.io.files import plain
from companion.view.snapshot import picture_of, scene_of
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.lockstep.flight import Flight, MemoryJournal

CONFIG = CompanionConfig(mission=SessionParams(engage="auto"))


def test_an_autopilot_is_lost_only_if_it_was_heard() -> None:
    flight = Flight(CONFIG, Scenario(), 1, MemoryJournal())
    companion = flight.companion
    assert companion is not None
    assert picture_of(companion, 0.0)["is_link_lost"] is False
    flight.run(2.0)
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
    assert drawn["own_words"] == "3.00 m, not told"
    assert picture["phase_detail"] == "approach: crossing 1, 18.8 m beyond the estimate"
