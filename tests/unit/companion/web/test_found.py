"""Located emitters go to the page as plain values, and come out as the same hand-off."""

from __future__ import annotations

import json

import msgspec

from companion.handoff import handoff_of
from companion.io.files import plain
from companion.web.handoff_dialog import LocalisedEmitter
from tests.loop.loop_helpers import Loop


def test_a_hand_off_of_the_page_is_the_flights_own() -> None:
    loop = Loop(seed=1)
    loop.run(36.0)
    estimate, origin = loop.companion.session.estimate, loop.companion.session.vehicle.origin
    assert estimate is not None
    assert origin is not None
    fields = {"emitter": "7", "estimate": estimate, "origin": origin, "unix_s": 1.8e9}
    found = msgspec.convert(json.loads(json.dumps(plain(fields))), LocalisedEmitter)
    assert found.handoff == handoff_of("7", estimate, origin, 1.8e9)
