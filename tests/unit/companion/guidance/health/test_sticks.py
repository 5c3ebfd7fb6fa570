"""Sticks that the pilot moves while the vehicle follows us."""

from __future__ import annotations

import pytest

from companion.guidance.commands import StickReaction
from companion.guidance.control_authority import Verdict
from companion.guidance.events import RcStatusReported, SticksReported
from companion.guidance.health.contention import StickWatch

REST = (0.0, 0.0, -1.0, 0.0)
"""Roll, pitch, throttle without a spring, yaw."""
RATE_S = 0.2


def watch_of(reaction: StickReaction = "yield") -> StickWatch:
    """Return the watch of a flight in control since 10 s."""
    watch = StickWatch(reaction)
    watch.handle(SticksReported(9.9, REST))
    watch.begin(10.0)
    return watch


def move(
    watch: StickWatch, deflections: tuple[float, ...], from_s: float, until_s: float
) -> dict[Verdict, float]:
    """Report sticks; when each verdict came first."""
    first: dict[Verdict, float] = {}
    for number in range(round((until_s - from_s) / RATE_S)):
        now_s = from_s + RATE_S * number
        watch.handle(SticksReported(now_s, deflections))
        finding = watch.step(now_s)
        if finding is not None:
            first.setdefault(finding.verdict, now_s)
    return first


def test_sticks_at_rest_mean_nothing_wherever_they_rest() -> None:
    watch = watch_of()
    assert move(watch, (0.05, -0.1, -0.9, 0.1), 10.0, 20.0) == {}


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("deflection", [0.4, -0.4])
def test_a_moved_stick_is_held_on_at_once_and_given_way_to_soon(
    axis: int, deflection: float
) -> None:
    watch = watch_of()
    moved = tuple(deflection if n == axis else v for n, v in enumerate(REST))
    first = move(watch, moved, 20.0, 22.0)
    assert first[Verdict.HOLD] == 20.0
    assert first[Verdict.YIELD] == pytest.approx(20.6, abs=0.01)


def test_pulses_of_a_lost_transmitter_are_no_pilot() -> None:
    watch = watch_of()
    watch.handle(RcStatusReported(19.9, is_healthy=False))
    assert move(watch, (0.0, 0.0, 1.0, 0.0), 20.0, 25.0) == {}


def test_pulses_that_move_before_the_loss_is_reported_are_held_on_only() -> None:
    watch = watch_of()
    watch.handle(RcStatusReported(19.9, is_healthy=True))
    first = move(watch, (0.0, 0.0, 1.0, 0.0), 20.0, 21.0)
    assert list(first) == [Verdict.HOLD]
    watch.handle(RcStatusReported(21.0, is_healthy=False))
    assert move(watch, (0.0, 0.0, 1.0, 0.0), 21.0, 25.0) == {}


def test_a_rating_after_the_move_gives_way() -> None:
    watch = watch_of()
    watch.handle(RcStatusReported(19.9, is_healthy=True))
    move(watch, (0.6, 0.0, -1.0, 0.0), 20.0, 21.0)
    watch.handle(RcStatusReported(21.0, is_healthy=True))
    assert Verdict.YIELD in move(watch, (0.6, 0.0, -1.0, 0.0), 21.0, 21.4)


def test_a_transmitter_that_is_heard_again_rests_where_it_is_then() -> None:
    watch = watch_of()
    watch.handle(RcStatusReported(19.9, is_healthy=False))
    watch.handle(RcStatusReported(25.0, is_healthy=True))
    assert move(watch, (0.6, 0.0, 0.0, 0.0), 25.2, 30.0) == {}
    assert Verdict.HOLD in move(watch, (0.0, 0.6, 0.0, 0.0), 30.0, 31.0)


def test_a_touch_is_held_on_for_two_seconds() -> None:
    watch = watch_of()
    watch.handle(SticksReported(20.0, (0.5, 0.0, -1.0, 0.0)))
    watch.handle(SticksReported(20.2, REST))
    for number in range(10):
        watch.handle(SticksReported(20.4 + RATE_S * number, REST))
    assert watch.step(21.9) is not None
    assert watch.step(22.1) is None


def test_a_reaction_is_a_matter_of_configuration() -> None:
    moved = (1.0, 0.0, -1.0, 0.0)
    assert set(move(watch_of("hold"), moved, 20.0, 25.0)) == {Verdict.HOLD}
    assert move(watch_of("ignore"), moved, 20.0, 25.0) == {}


def test_letting_go_of_a_stick_after_the_mode_switch_is_no_wish() -> None:
    watch = StickWatch("yield")
    watch.handle(SticksReported(9.9, (0.6, 0.0, 0.5, 0.0)))
    watch.begin(10.0)
    assert move(watch, (0.6, 0.0, 0.5, 0.0), 10.0, 12.0) == {}
    assert move(watch, (0.0, 0.0, 0.0, 0.0), 12.0, 15.0) == {}
    assert Verdict.YIELD in move(watch, (0.0, 0.6, 0.0, 0.0), 15.0, 17.0)


def test_a_transmitter_that_appears_with_a_moved_stick_is_a_wish() -> None:
    watch = StickWatch("yield")
    watch.begin(10.0)
    assert Verdict.YIELD in move(watch, (0.0, 0.8, -1.0, 0.0), 20.0, 22.0)


def test_a_transmitter_that_is_switched_on_in_flight_rests_where_it_is() -> None:
    watch = StickWatch("yield")
    watch.begin(10.0)
    assert watch.step(11.0) is None
    assert move(watch, (0.0, 0.0, 1.0, 0.0), 20.0, 25.0) == {}


def test_a_transmitter_that_falls_silent_is_not_moved() -> None:
    watch = watch_of()
    watch.handle(SticksReported(20.0, (0.5, 0.0, -1.0, 0.0)))
    assert watch.step(20.1) is not None
    assert watch.step(25.0) is None
