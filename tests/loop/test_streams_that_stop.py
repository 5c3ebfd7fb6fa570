"""Each stream that control leans on stops before ready, at ready and in control, and is named."""

from __future__ import annotations

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import Autopilot
from companion.guidance.phases import IN_CONTROL, Phase
from companion.guidance.readiness import REQUIREMENTS
from companion.link.autopilot_queries import STALE_AFTER_S
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import LinkBlackout, StreamMute
from tests.loop.loop_helpers import AUTO, SELDOM, Loop, flown_once

FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
AUTOPILOTS = {"px4": Autopilot.PX4, "ardupilot": Autopilot.ARDUPILOT}
STREAMS = tuple(
    (flavour, row.text, row.message)
    for row in REQUIREMENTS
    for flavour in FLAVOURS
    if row.is_needed(AUTOPILOTS[flavour])
    and row.text not in ("the origin", "the autopilot's fence")
)
"""The two others are read once, and tests/loop/test_third_parties.py changes them."""
ONLY_HERE = {"ESTIMATOR_STATUS": "px4", "EKF_STATUS_REPORT": "ardupilot"}
LEANT_ON = tuple(
    (flavour, mavlink.mavlink_map[number].msgname, word, stale_after_s)
    for number, (word, stale_after_s) in STALE_AFTER_S.items()
    for flavour in FLAVOURS
    if ONLY_HERE.get(mavlink.mavlink_map[number].msgname, flavour) == flavour
    and number != mavlink.MAVLINK_MSG_ID_RC_CHANNELS  # there is no transmitter
)


def start(flavour: FlavourName, config: CompanionConfig) -> Loop:
    return Loop(
        config, Scenario(autopilot=AutopilotParams(flavour=flavour), payload=SELDOM), seed=3
    )


@flown_once
def standing_by(flavour: FlavourName) -> Loop:
    loop = start(flavour, CompanionConfig())
    loop.run_until(lambda: loop.phase is Phase.STANDBY, 30.0)
    return loop


@flown_once
def searching(flavour: FlavourName) -> Loop:
    loop = start(flavour, AUTO)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    return loop


def take_away(loop: Loop, text: str, message: str) -> None:
    gone = LinkBlackout() if text == "the autopilot" else StreamMute(message=message)
    loop.wire.add(gone, loop.now_s)


@pytest.mark.parametrize(("flavour", "text", "message"), STREAMS)
def test_what_never_comes_keeps_it_from_being_ready(
    flavour: FlavourName, text: str, message: str
) -> None:
    loop = start(flavour, CompanionConfig())
    take_away(loop, text, message)
    loop.run(25.0)
    assert loop.phase is Phase.WAITING
    assert not loop.said("ready: switch")
    is_heard = message != "HEARTBEAT"
    assert loop.said(f"waiting for {text}") == is_heard


@pytest.mark.parametrize(("flavour", "text", "message"), STREAMS)
def test_what_stops_at_ready_is_named_and_a_mode_gives_no_control(
    flavour: FlavourName, text: str, message: str
) -> None:
    loop = standing_by(flavour)
    take_away(loop, text, message)
    loop.run(13.0)
    is_known_once = message == "HOME_POSITION"
    assert loop.said("not ready: ") is not is_known_once
    assert loop.phase not in IN_CONTROL


@pytest.mark.parametrize(("flavour", "name", "word", "stale_after_s"), LEANT_ON)
def test_what_stops_in_control_is_named_after_its_patience(
    flavour: FlavourName, name: str, word: str, stale_after_s: float
) -> None:
    loop = searching(flavour)
    loop.wire.add(StreamMute(message=name), loop.now_s)
    loop.run(0.5 * stale_after_s)
    assert not loop.said(f"no {word} any more")
    loop.run(0.5 * stale_after_s + 6.0)  # a text on streams every 5 s
    named = [text for _, text in loop.notes.texts if text.startswith("no ") and word in text]
    assert named, loop.notes.texts
    assert named[0].endswith("any more: requesting again")
