"""Texts with the same cause are sent once in 30 s, unless a person did something in between."""

from __future__ import annotations

import numpy as np
import pytest

from companion.link.outbound import status_text
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.scenario import Scenario
from sim_link.autopilot.vehicle import SimVehicle
from sim_link.lab.monitor.authority_invariants import FewTexts
from sim_link.lab.monitor.scene import Rules, TrueScene
from sim_link.lab.observer import Frame, Lane

RULES = Rules(fence_enu_m=((0.0, 0.0), (9.0, 0.0), (9.0, 9.0)))
AUTOPILOT, OPERATOR, COMPANION = (1, 1), (255, 190), (1, 191)
LONG = "hold: no ranging for {} s, and this text does not fit into one chunk of STATUSTEXT"
HOLD, GUIDED, ARMED = 5, 4, 128


def heartbeat(mode: int, flags: int = ARMED) -> Message:
    return mavlink.MAVLink_heartbeat_message(2, 3, flags, mode, 4, 3)


class Judged:
    """An invariant, and what is sent and heard at its times."""

    def __init__(self) -> None:
        self.scene = TrueScene(RULES, vehicle=SimVehicle(Scenario(), np.random.default_rng(1)))
        self.few = FewTexts(self.scene)
        self._texts = 0

    def say(self, now_s: float, text: str) -> Judged:
        self._texts += 1
        for message in status_text(4, text, self._texts):
            self._show("sent", now_s, message, COMPANION)
        return self

    def hear(self, now_s: float, message: Message, sender: tuple[int, int] = AUTOPILOT) -> Judged:
        self._show("heard", now_s, message, sender)
        return self

    def _show(self, what: str, now_s: float, message: Message, sender: tuple[int, int]) -> None:
        self.scene.now_s = now_s
        data = MavCodec(*sender).encode(message)
        getattr(self.few, what)(Frame(now_s, data, Lane.TO_COMPANION))

    @property
    def found(self) -> list[str]:
        return [violation.what for violation in self.scene.violations]


@pytest.mark.parametrize("text", ["hold: no ranging for {} s", LONG, "x" * 50])
@pytest.mark.parametrize(("after_s", "is_found"), [(29.9, True), (30.1, False)])
def test_the_same_words_with_other_figures_are_found(
    text: str, after_s: float, *, is_found: bool
) -> None:
    judged = Judged().say(1.0, text.format(5.2)).say(1.0 + after_s, text.format(17))
    what = f"the same text again: {text.format('#')}"
    assert judged.found == ([what] if is_found else [])


def test_other_words_and_another_emitter_are_another_cause() -> None:
    judged = Judged()
    for text in ("hold: no ranging", "hold: stale", "emitter 7 lost", "emitter 8 lost"):
        judged.say(1.0, text)
    assert judged.found == []


def test_the_copy_for_another_link_is_no_repetition() -> None:
    assert Judged().say(1.0, "hold: stale").say(1.0, "hold: stale").found == []


def test_a_new_process_knows_nothing_of_the_one_before() -> None:
    judged = Judged().say(1.0, "resumed")
    judged.few.started()
    assert judged.say(5.0, "resumed").found == []


@pytest.mark.parametrize(
    ("message", "sender", "is_excused"),
    [
        (heartbeat(GUIDED), AUTOPILOT, True),
        (heartbeat(HOLD, 0), AUTOPILOT, True),
        (heartbeat(HOLD), AUTOPILOT, False),
        (heartbeat(GUIDED), (2, 1), False),
        (mavlink.MAVLink_command_long_message(1, 191, 92, 0, *[0.0] * 7), OPERATOR, True),
        (mavlink.MAVLink_param_set_message(1, 191, b"CMP_SPEED", 3.0, 9), OPERATOR, True),
        (mavlink.MAVLink_system_time_message(1, 1), AUTOPILOT, False),
    ],
)
def test_what_a_person_did_since_excuses_it(
    message: Message, sender: tuple[int, int], *, is_excused: bool
) -> None:
    judged = Judged().hear(0.5, heartbeat(HOLD)).say(1.0, "refused").hear(2.0, message, sender)
    assert judged.say(3.0, "refused").found == (
        [] if is_excused else ["the same text again: refused"]
    )
