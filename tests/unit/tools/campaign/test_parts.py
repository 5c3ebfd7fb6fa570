"""Every part of a campaign, as short as is useful: it measures, and finds nothing."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from sim_link.lab.faults.fault_models import KINDS
from sim_link.lab.observer import Frame, Lane
from tools.campaign.checkpointing import MemoryStore
from tools.campaign.endurance import Usage, random_frames
from tools.campaign.flights import Trial
from tools.campaign.link_trials import Gaps, pauses_of
from tools.campaign.process_trials import damages
from tools.campaign.random_missions import MAX_FAULTS, mission_case
from tools.campaign.runner import PARTS, run_one

SMALL = {"gaps": 0.003, "forged": 0.1, "fuzz": 0.05, "soak": 0.01}
MEASURES = {
    "missions": "missions",
    "override": "overrides",
    "gaps": "max_gap_s",
    "kill": "kills",
    "stop": "stops",
    "forged": "attack_frames",
    "fuzz": "fuzz_frames",
    "reaction": "hold_after_stale_s",
    "clocks": "clock_flights",
    "soak": "soak_hours",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MEASURES)
def test_a_short_trial_of_every_part_finds_nothing(name: str) -> None:
    outcome = run_one(Trial(name, 5, SMALL.get(name, 1.0)))
    assert outcome.findings == ()
    assert {**outcome.sums, **outcome.most}[MEASURES[name]] > 0.0


def test_every_part_is_tried() -> None:
    assert {*MEASURES, "signal"} == set(PARTS)  # which tests/e2e/test_process_trials.py tries


NOT_DRAWN = {
    "rc_loss",  # a random mission has no transmitter that could be lost
}


@pytest.mark.slow
def test_random_missions_meet_every_fault_autopilot_and_planner() -> None:
    cases = [mission_case(seed) for seed in range(400)]
    kinds = {f.__struct_config__.tag for case in cases for f in case.schedule.faults}
    assert kinds == set(KINDS) - NOT_DRAWN
    assert {case.scenario.autopilot.flavour for case in cases} == {"px4", "ardupilot"}
    assert len({case.config.planner.flown for case in cases}) == 5
    searches = {case.config.planner.search for case in cases}
    assert searches == {None, "lawnmower", "expanding_square", "sector", "probability"}
    assert {len(case.schedule.faults) - 2 for case in cases} == set(range(1, MAX_FAULTS + 1))
    assert max(case.config.limits.speed_mps for case in cases) == 10.0
    assert 0.2 < sum(case.is_signed for case in cases) / len(cases) < 0.4
    assert mission_case(7) == mission_case(7)


def test_damage_reaches_every_byte_from_seed_to_seed() -> None:
    store = MemoryStore()
    store.slots = {0: bytes(range(200)), 1: b"older"}
    cut, flipped = set(), set()
    for seed in range(10):
        for slots in damages(store, seed):
            (data,) = slots.values()
            if len(data) < 200:
                cut.add(len(data))
            else:
                flipped |= {i for i in range(200) if data[i] != i}
    assert cut | flipped == set(range(200))
    assert damages(MemoryStore(), 1) == []


def test_random_frames_are_frames() -> None:
    reader = MavCodec(9, 9)
    for frame in itertools.islice(random_frames(np.random.default_rng(1), None), 500):
        reader.decode(frame)
    assert reader.counters.good == 500
    assert reader.counters.bad_crc == 0


def test_a_slope_is_reported_from_after_the_settling() -> None:
    hours = [0.5 * i for i in range(10)]
    values = [10.0 if h < 1.0 else 20.0 + 0.3 * h for h in hours]
    assert Usage(hours, values).slope_mb_per_h == pytest.approx(0.3)
    assert Usage([0.1], [5.0]).slope_mb_per_h == 0.0


DAY_H = [0.25 * i for i in range(1, 97)]


@pytest.mark.parametrize(
    ("growth_mb_per_h", "descriptors", "log_bytes", "findings"),
    [
        (0.05, 9, 20_000_000, []),
        (0.15, 9, 20_000_000, ["memory grows by 0.150 MB/h"]),
        (0.0, 10, 20_000_000, ["9 descriptors became 10"]),
        (0.0, 9, 23_000_000, ["the log has 23000000 bytes, its cap is 20000000"]),
    ],
)
def test_a_day_that_takes_more_and_more_of_the_machine_is_found(
    growth_mb_per_h: float, descriptors: int, log_bytes: int, findings: list[str]
) -> None:
    memory_mb = [130.0 + 5.0 * min(h, 1.0) + growth_mb_per_h * h for h in DAY_H]
    counts: list[int | None] = [9] * (len(DAY_H) - 1)
    usage = Usage(DAY_H, memory_mb, [*counts, descriptors], log_bytes)
    assert usage.findings() == findings


def test_a_pause_of_the_setpoints_is_a_finding() -> None:
    gaps = Gaps()
    gaps.is_counting = True
    setpoint = MavCodec(1, 191).encode(
        mavlink.MAVLink_set_position_target_local_ned_message(*[0] * 16)
    )
    for time_s in (1.0, 1.3, 1.85):
        gaps.vehicle_heard(Frame(time_s, setpoint, Lane.TO_VEHICLE, is_intact=True))
    assert gaps.worst_s == pytest.approx(0.55)
    assert gaps.over_half_s == 1
    assert [pauses_of(gaps, share) for share in (0.1, 0.5)] == [
        ["gap of 0.550 s at 10% loss"],
        ["gap of 0.550 s at 50% loss"],
    ]
    gaps.worst_s = 0.45
    assert pauses_of(gaps, 0.5) == []
    assert pauses_of(gaps, 0.3) == ["gap of 0.450 s at 30% loss"]


def test_a_link_that_was_lost_is_counted() -> None:
    gaps = Gaps()
    gaps.noted("text", {"text": "hold: autopilot link lost"}, 1.0)
    gaps.is_counting = True
    gaps.noted("text", {"text": "hold: autopilot link lost"}, 2.0)
    assert gaps.false_losses == 1
