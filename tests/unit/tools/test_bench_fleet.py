from __future__ import annotations

from dataclasses import replace

import pytest

from tools.benches.bench_fleet import Outcome, Track

GOOD = Outcome(
    count=10,
    flying=10,
    core_share=0.18,
    waiting_share=0.0,
    frames_hz=3_600.0,
    lag_s=0.02,
    worst_rate_hz=20.0,
)


def test_real_time_tells_for_how_many_a_core_has_room() -> None:
    assert GOOD.holds
    assert GOOD.line("px4").endswith("real time; by this a core has room for 50")


@pytest.mark.parametrize(
    "worse",
    [
        replace(GOOD, flying=9),
        replace(GOOD, lag_s=0.3),
        replace(GOOD, worst_rate_hz=18.9),
    ],
)
def test_one_that_stays_down_a_lag_or_a_slow_stream_is_no_real_time(worse: Outcome) -> None:
    assert not worse.holds
    assert worse.line("px4").endswith("NOT real time")


def test_a_track_tells_the_time_that_passed_for_its_vehicle() -> None:
    track = Track()
    for boot_ms in (5_000, 5_050, 7_000):
        track.take(boot_ms)
    assert (track.count, track.simulated_s) == (3, 2.0)
