from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.geometry.coordinates import wrap_pi
from sim_link.world.environment import (
    NO_MEMORY,
    ChannelParams,
    Emitter,
    EmitterParams,
    ObstacleParams,
)
from sim_link.world.radio_channel import MIN_RANGE_M, RadioChannel
from tests.unit.tools.study.reporting.case_helpers import canonical_case
from tools.study.case import (
    BENT,
    CHANNEL,
    OBSTRUCTED,
    PLANNER,
    TRUTH,
    Case,
    channel_draws,
    drawn,
    measured,
    measured_in,
    run_seeds,
    scene_of,
    stream,
    truth_of,
)


def test_the_numbers_are_those_of_the_simulated_radio() -> None:
    params, seed = ChannelParams(), run_seeds(5, 1)[0]
    radio = RadioChannel(params, stream(seed, CHANNEL))
    emitter = Emitter(EmitterParams())
    truth = truth_of(Case(channel=params), stream(seed, TRUTH))
    for step, draw in enumerate(drawn(stream(seed, CHANNEL), 60)):
        position = (10.0 + step, 80.0 - 1.5 * step, 0.0)
        seen = radio.measure(emitter, position, 0.0)
        range_m, bearing_rad = measured(draw, position[0], position[1], truth)
        assert seen.range_m == pytest.approx(range_m, rel=1e-12)
        assert seen.bearing_enu_rad == pytest.approx(wrap_pi(bearing_rad), rel=1e-9, abs=1e-12)


def test_a_measured_range_stays_positive() -> None:
    truth = truth_of(Case(channel=ChannelParams(range_offset_m=-5.0)), np.random.default_rng(0))
    draw = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert measured(draw, truth.east_m, truth.north_m, truth)[0] == MIN_RANGE_M


def test_paths_obstructed_at_little_nlos_are_obstructed_at_much() -> None:
    draws = drawn(stream(1, CHANNEL), 400)
    lengths = []
    for p_nlos in (0.0, 0.3, 0.9):
        truth = truth_of(canonical_case(p_nlos=p_nlos), stream(1, TRUTH))
        lengths.append(np.array([measured(draw, 0.0, 0.0, truth)[0] for draw in draws]))
    assert (lengths[0] <= lengths[1]).all()
    assert (lengths[1] <= lengths[2]).all()
    assert np.mean(lengths[2] > lengths[0]) == pytest.approx(0.9, abs=0.05)


def test_streams_and_runs_are_independent_and_repeatable() -> None:
    first, second = run_seeds(7, 2)
    firsts = {stream(seed, which).random() for seed in (first, second) for which in range(3)}
    assert len(firsts) == 6
    assert stream(first, PLANNER).random() == stream(first, PLANNER).random()


def test_a_run_keeps_its_seed_whatever_runs_before_it() -> None:
    assert run_seeds(7, 5)[3].spawn_key == run_seeds(7, 1, first=3)[0].spawn_key
    assert stream(run_seeds(7, 5)[3], TRUTH).random() == (
        stream(run_seeds(7, 1, first=3)[0], TRUTH).random()
    )


def test_a_plain_number_is_a_seed() -> None:
    assert stream(3, TRUTH).random() == stream(np.random.SeedSequence(3), TRUTH).random()


def test_offsets_are_the_channels_or_drawn_from_the_priors() -> None:
    case = Case()
    truth = truth_of(case, stream(1, TRUTH))
    assert truth.range_offset_m == 1.5
    assert truth.bearing_offset_rad == pytest.approx(math.radians(-3.0))
    drawn_case = msgspec.structs.replace(case, offsets="prior")
    truths = [truth_of(drawn_case, stream(seed, TRUTH)) for seed in run_seeds(1, 400)]
    assert np.std([t.range_offset_m for t in truths]) == pytest.approx(5.0, rel=0.1)
    spread_deg = np.degrees(np.std([t.bearing_offset_rad for t in truths]))
    assert spread_deg == pytest.approx(5.0, rel=0.1)


def test_one_draw_decides_for_range_and_bearing_unless_the_case_parts_them() -> None:
    joint = channel_draws(Case(), 4)
    separate = channel_draws(Case(nlos_draws="separate"), 4)
    assert np.array_equal(joint[:, BENT], joint[:, OBSTRUCTED])
    assert np.array_equal(separate[:, :BENT], joint[:, :BENT])
    assert abs(np.corrcoef(separate[:, BENT], separate[:, OBSTRUCTED])[0, 1]) < 0.2
    truth = truth_of(canonical_case(p_nlos=0.5), stream(4, TRUTH))
    clear = truth._replace(p_nlos=0.0)
    is_long, is_bent = (
        np.array(
            [measured(d, 0.0, 0.0, truth)[i] != measured(d, 0.0, 0.0, clear)[i] for d in draws]
        )
        for draws, i in ((separate, 0), (separate, 1))
    )
    assert np.mean(is_long & ~is_bent) == pytest.approx(0.25, abs=0.06)


def test_behind_an_obstacle_every_path_is_obstructed() -> None:
    block = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)))
    case = msgspec.structs.replace(canonical_case(p_nlos=0.0), obstacles=(block,))
    truth, scene = truth_of(case, stream(2, TRUTH)), scene_of(case)
    draws = channel_draws(case, 2)
    shaded = [measured_in(d, 10.0, 40.0, truth, scene, NO_MEMORY)[0] for d in draws]
    lit = [measured_in(d, 50.0, 10.0, truth, scene, NO_MEMORY)[0] for d in draws]
    assert lit == [measured(d, 50.0, 10.0, truth)[0] for d in draws]
    extra_m = np.array(shaded) - np.array([measured(d, 10.0, 40.0, truth)[0] for d in draws])
    assert extra_m.min() > 0.0
    assert extra_m.mean() == pytest.approx(15.0, rel=0.15)


def test_without_obstacles_nothing_is_remembered() -> None:
    truth, draw = truth_of(Case(), stream(2, TRUTH)), channel_draws(Case(), 2)[0]
    *seen, memory = measured_in(draw, 1.0, 2.0, truth, scene_of(Case()), NO_MEMORY)
    assert tuple(seen) == measured(draw, 1.0, 2.0, truth)
    assert memory is NO_MEMORY


def test_obstacles_take_the_whole_path() -> None:
    block = ObstacleParams(corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0)))
    with pytest.raises(ValueError, match="joint"):
        Case(obstacles=(block,), nlos_draws="separate")
