"""A radio that lies, hangs, stutters or falls silent: what is flown on it, and what not."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest

from companion.domain import EstimateState
from companion.estimation.screen import Objection, RejectReason
from companion.guidance.phases import FLYING, Phase
from sim_link.autopilot.incidents import FaultRecord
from sim_link.lab.faults.fault_models import (
    LinkHold,
    RangingDropout,
    RangingFreeze,
    RangingNan,
    RangingOutliers,
    RangingOutOfOrder,
    RangingSecondEmitter,
    RangingStale,
    RangingWrongUnit,
)
from tests.loop.loop_helpers import Loop, flown_once, outside

pytestmark = pytest.mark.slow

FACTORS = (0.001, 0.01, 57.3, 100.0, 1000.0)
TICK_S = 0.05


@flown_once
def in_control(after_s: float, seed: int) -> Loop:
    """Return a flight in control that has followed the plan for a while."""
    loop = Loop(seed=seed)
    loop.run_until(lambda: loop.phase is Phase.NORMAL, 60.0)
    loop.run(after_s)
    return loop


def flying(fault: FaultRecord | None = None, after_s: float = 0.0, seed: int = 1) -> Loop:
    """Return a flight in control for a while, in which the fault then begins."""
    loop = in_control(after_s, seed)
    if fault is not None:
        loop.wire.add(fault, loop.now_s)
    return loop


def phases(loop: Loop, seconds: float) -> list[tuple[float, Phase]]:
    """Return the phases of a flight, tick by tick."""
    began_s, seen = loop.now_s, []
    while loop.now_s < began_s + seconds:
        loop.run(TICK_S)
        seen.append((loop.now_s - began_s, loop.phase))
    return seen


def last_flown_s(seen: list[tuple[float, Phase]]) -> float:
    """Return the last time in a phase that flies the plan."""
    return max((time_s for time_s, phase in seen if phase in FLYING), default=0.0)


def refused(loop: Loop) -> dict[RejectReason, int]:
    return dict(loop.companion.session.tracker.rejected)


# -- Wrong units


@pytest.mark.parametrize("of", ["range", "bearing"])
@pytest.mark.parametrize("factor", FACTORS)
def test_in_a_wrong_unit_from_the_start_nothing_is_ever_flown(of: str, factor: float) -> None:
    loop = Loop()
    loop.wire.add(wrong(of, factor), 0.0)
    seen = phases(loop, 25.0)
    assert any(phase is Phase.HOLD for _, phase in seen)
    assert last_flown_s(seen) == 0.0


@pytest.mark.parametrize("of", ["range", "bearing"])
@pytest.mark.parametrize("factor", FACTORS)
def test_a_unit_that_becomes_wrong_in_flight_is_held_on_within_three_seconds(
    of: str, factor: float
) -> None:
    loop = flying(wrong(of, factor), after_s=1.0 if factor < 1.0 else 6.0)
    seen = phases(loop, 10.0)
    assert last_flown_s(seen) <= 3.0
    objection = Objection.RANGE_UNIT if of == "range" else Objection.BEARING_UNIT
    assert loop.companion.session.tracker.objection(loop.now_s) is objection
    assert loop.said(f"hold: {objection.value}")


def test_once_the_unit_is_right_again_the_target_is_found() -> None:
    loop = flying(RangingWrongUnit(of="range", factor=0.01, duration_s=8.0), 4.0)
    loop.run(8.0)
    assert loop.phase is Phase.HOLD
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.5


def wrong(of: str, factor: float) -> RangingWrongUnit:
    return RangingWrongUnit(of="range" if of == "range" else "bearing", factor=factor)


# -- Frozen, silent


def test_a_frozen_radio_is_a_dropout() -> None:
    loop = flying(RangingFreeze(duration_s=10.0), 4.0)
    seen = phases(loop, 10.0)
    counts = refused(loop)
    assert counts[RejectReason.FROZEN] > 20
    assert Phase.HOLD in {phase for time_s, phase in seen if time_s > 7.0}
    assert last_flown_s(seen) <= 6.6  # a second to notice, five of patience
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.5


@pytest.mark.parametrize("missing", ["range", "bearing"])
def test_without_one_kind_the_other_is_flown_on_and_ages_tell(missing: str) -> None:
    fault = RangingDropout(missing="range" if missing == "range" else "bearing", duration_s=5.0)
    loop = flying(fault, 6.0)
    loop.run(4.0)
    contact = loop.companion.session.tracker.integrity.contact
    ages = {"range": contact.range_age_s(loop.now_s), "bearing": contact.bearing_age_s(loop.now_s)}
    lost_s = ages.pop(missing)
    (heard_s,) = ages.values()
    assert lost_s == pytest.approx(4.0, abs=0.3)
    assert heard_s is not None
    assert heard_s < 0.4
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.5


@pytest.mark.parametrize("gap_s", [0.5, 2.5, 8.0])
def test_a_gap_of_any_length_is_survived(gap_s: float) -> None:
    loop = flying(RangingDropout(missing="both", duration_s=gap_s), 5.0)
    seen = phases(loop, gap_s)
    assert (Phase.DEGRADED in {phase for _, phase in seen}) is (gap_s > 2.2)
    assert (Phase.HOLD in {phase for _, phase in seen}) is (gap_s > 5.2)
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.5


# -- Wrong, late, many


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_outliers_are_flown_through(share: float) -> None:
    loop = Loop()
    loop.wire.add(RangingOutliers(share=share), 0.0)
    loop.run_until(lambda: bool(loop.notes.results), 150.0)
    assert loop.error_m <= 1.5
    assert outside(loop.true_positions, 150.0) == []


FAULTS: dict[str, tuple[Callable[[], FaultRecord], RejectReason | None]] = {
    "no numbers": (lambda: RangingNan(share=0.5), RejectReason.NOT_FINITE),
    "late": (lambda: RangingStale(age_s=0.8), None),
    "too late by turns": (lambda: RangingOutOfOrder(window_s=1.4), RejectReason.STALE),
    "out of order": (lambda: RangingOutOfOrder(window_s=0.9), None),
    "another emitter": (lambda: RangingSecondEmitter(emitter_id=0), RejectReason.OTHER_EMITTER),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_cannot_be_used_is_counted_and_the_rest_suffices(name: str) -> None:
    make, reason = FAULTS[name]
    loop = flying(make())
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.5
    assert reason is None or refused(loop)[reason] > 10


def test_a_burst_after_three_seconds_moves_nothing_suddenly() -> None:
    loop = flying(LinkHold(direction="to_companion", duration_s=3.0), 6.0)
    loop.run(2.9)
    released_s = loop.now_s
    loop.run(3.0)
    sent = loop.setpoints_since(released_s)
    steps_m = [
        math.dist(one.position_enu_m, other.position_enu_m)
        for one, other in itertools.pairwise(sent)
        if other.time_s - one.time_s < 0.2
    ]
    assert max(steps_m) <= 5.0 * 0.2 + 0.01
    loop.run_until(lambda: bool(loop.notes.results), 90.0)
    assert loop.error_m <= 1.5


def test_two_emitters_under_one_id_never_count_as_one_place_found() -> None:
    """Half of the answers are from another one, 60 m away: neither is reported as certain."""
    loop = flying(RangingSecondEmitter(), 4.0)
    loop.run(40.0)
    for _, report in loop.notes.results:
        truth = loop.flight.scenario.emitter.position_enu_m
        found = report.estimate.position_enu_m
        assert min(math.dist(found, truth), math.dist(found, (0.0, 60.0))) <= 3.0
    assert outside(loop.true_positions, 150.0) == []


def test_the_health_of_the_estimate_is_in_the_event_log() -> None:
    loop = flying(RangingOutliers(share=0.4))
    loop.run(25.0)
    health = [fields for _, kind, fields in loop.notes.records if kind == "health"]
    assert {"range_age_s", "bearing_age_s", "agreeing", "objection"} <= set(health[-1])
    status = loop.companion.session.status(loop.now_s)
    assert status.refused
    assert status.estimate is not None
    assert status.estimate.state in EstimateState
