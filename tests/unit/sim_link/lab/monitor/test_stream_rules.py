"""Pauses of the stream of setpoints that are allowed, and those that are an offence."""

from __future__ import annotations

import pytest

from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import Scenario
from sim_link.lab.monitor.authority_invariants import KeepsStreaming
from sim_link.lab.monitor.scene import ObservedScene, SentSetpoint
from tests.loop.loop_helpers import AUTO
from tools.campaign.flights import monitored_flight

STEP_S = 0.02
SETPOINT = mavlink.MAVLink_set_position_target_local_ned_message(
    0, 1, 1, 1, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
)


class Stream:
    """Setpoints of a companion in control, until it falls silent."""

    def __init__(self) -> None:
        self.scene: ObservedScene = monitored_flight(AUTO, Scenario(), 1).monitor.scene
        self.invariant = KeepsStreaming(self.scene)
        observed = self.scene.observed
        observed.is_ours, observed.heartbeat_s, observed.position_enu_m = (
            True,
            0.0,
            (0.0, 0.0, 15.0),
        )
        self.invariant.noted("phase", {"new": "hold"})

    def lasts(
        self,
        until_s: float,
        *,
        is_silent: bool = False,
        is_fresh: bool = True,
        is_mode_heard: bool = True,
    ) -> None:
        """Let time pass, with mode and position of the vehicle at every step."""
        scene = self.scene
        while scene.now_s < until_s:
            scene.now_s += STEP_S
            if is_mode_heard:
                scene.observed.heartbeat_s = scene.now_s
            if is_fresh:
                scene.observed.position_s = scene.observed.position_sent_s = scene.now_s
            if not is_silent:
                self.invariant.setpoint(SentSetpoint(scene.now_s, (0.0, 0.0, 15.0), SETPOINT))
            self.invariant.stepped()

    @property
    def has_paused(self) -> bool:
        return bool(self.scene.violations)


@pytest.fixture
def stream() -> Stream:
    stream = Stream()
    stream.lasts(1.0)
    return stream


def test_a_pause_without_a_reason_is_found(stream: Stream) -> None:
    assert not stream.has_paused
    stream.lasts(1.3, is_silent=True)
    assert stream.has_paused


def test_a_setpoint_that_was_sent_is_sent_on_whatever_becomes_of_the_position(
    stream: Stream,
) -> None:
    stream.lasts(2.0, is_fresh=False)
    assert not stream.has_paused
    stream.lasts(2.3, is_silent=True, is_fresh=False)
    assert stream.has_paused


def test_how_old_the_places_of_a_stranger_are_only_the_companion_knows(stream: Stream) -> None:
    stream.scene.is_lied_to = True
    stream.lasts(1.5, is_silent=True)
    assert not stream.has_paused
    stream.scene.is_lied_to = False
    stream.lasts(1.8, is_silent=True)
    assert stream.has_paused


@pytest.mark.parametrize(("until_s", "has_paused"), [(1.5, False), (1.8, True)])
def test_a_frame_that_moved_settles_within_half_a_second(
    stream: Stream, until_s: float, *, has_paused: bool
) -> None:
    stream.scene.observed.frame_sent_at = (1.0, 100)
    stream.lasts(until_s, is_silent=True)
    assert stream.has_paused is has_paused


def test_after_a_stall_it_has_two_seconds_to_learn_who_flies(stream: Stream) -> None:
    stream.scene.suspended_until_s = 2.0
    stream.lasts(3.9, is_silent=True)
    assert not stream.has_paused
    stream.lasts(4.3, is_silent=True)
    assert stream.has_paused


@pytest.mark.parametrize("missing", ["is_fresh", "is_mode_heard"])
def test_and_as_long_as_mode_or_place_are_missing(stream: Stream, missing: str) -> None:
    stream.scene.suspended_until_s = 2.0
    stream.lasts(2.0, is_silent=True)
    stream.lasts(9.0, is_silent=True, **{missing: False})
    assert not stream.has_paused
    stream.lasts(11.5, is_silent=True)
    assert stream.has_paused


def test_who_sends_is_in_no_stall_any_more(stream: Stream) -> None:
    stream.scene.suspended_until_s = 2.0
    stream.lasts(2.1, is_silent=True)
    stream.lasts(2.2)
    assert not stream.has_paused
    stream.lasts(2.5, is_silent=True)
    assert stream.has_paused


def test_a_stall_before_control_is_given_counts_too(stream: Stream) -> None:
    stream.invariant.noted("phase", {"new": "launching"})
    stream.scene.suspended_until_s = 2.0
    stream.lasts(2.0, is_silent=True)
    stream.invariant.noted("phase", {"new": "hold"})
    stream.lasts(2.5, is_silent=True)
    assert not stream.has_paused
