"""Calibration of simulated radios whose truth is known, and every refusal."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.io.radio_recording import TimedPose
from companion.radio_tools.calibration import Calibration, CalibrationRun, RunWindow, calibrate
from companion.radio_tools.calibration_text import verdict
from companion.radio_tools.clustered_fit import ratio_figure
from tests.unit.companion.radio_tools.simulated_radio import (
    POINT,
    Course,
    Score,
    Truth,
    all_tests,
    at,
    drawn_run,
    scores,
    simulated,
)


def line(distances: tuple[float, ...] = (5.0, 10.0, 20.0, 50.0, 100.0)) -> Course:
    course = Course([at(distances[0])], [0.3])
    for distance in distances:
        course.go(at(distance), 3.0)
        course.stay(6.0)
    return course


def out_and_back() -> Course:
    course = line()
    course.go(at(5.0), 4.0)
    return course


def turns() -> Course:
    course = Course([at(30.0)], [0.3])
    for turn in (2.0 * math.pi, -2.0 * math.pi):
        course.stay(3.0)
        course.stay(40.0, turn)
    return course


def run_of(truth: Truth, course: Course, seed: int = 1) -> CalibrationRun:
    return simulated(truth, np.random.default_rng(seed), course)


def calibrated(truth: Truth, course: Course, seed: int = 1) -> Calibration:
    return calibrate(run_of(truth, course, seed))


def only_ranges(run: CalibrationRun) -> CalibrationRun:
    kept = [replace(m, bearing_body_rad=None, bearing_sigma_rad=None) for m in run.measurements]
    return replace(run, measurements=kept)


def only_bearings(run: CalibrationRun) -> CalibrationRun:
    kept = [replace(m, range_m=None, range_sigma_m=None) for m in run.measurements]
    return replace(run, measurements=[m for m in kept if m.bearing_body_rad is not None])


QUIET = Truth(nlos_share=0.05, scatter_m=0.1, between_m=0.05, correlation_m=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("first", [1, 5])
def test_radios_of_any_kind_come_out_as_they_are(first: int) -> None:
    found: list[Score] = []
    for seed in range(first, first + 4):
        truth, run = drawn_run(seed)
        done = calibrate(run)
        assert done.refusals == []
        found += scores(truth, done)
    for score in found:
        assert score.is_within is not False, score
    covered = [score.is_covered for score in found if score.is_covered is not None]
    assert np.mean(covered) > 0.7


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    found: list[Score] = []
    for seed in range(1001, 1041):
        truth, run = drawn_run(seed)
        found += scores(truth, calibrate(run))
    signs = [score.is_within for score in found if score.name == "sign, fold"]
    assert len(signs) >= 38
    assert all(signs)
    for name in ("offset m", "scale", "lag s", "mount deg"):
        own = [score for score in found if score.name == name]
        assert len(own) >= 30
        assert np.mean([score.is_covered is True for score in own]) > 0.85, name
        assert np.mean([score.is_within is not False for score in own]) > 0.95, name


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("mount_deg", [-170.0, -60.0, 0.0, 12.0, 95.0, 180.0])
def test_sign_and_mount_are_found_whichever_way_the_antenna_looks(
    sign: int, mount_deg: float
) -> None:
    truth = replace(QUIET, sign=sign, mount_rad=math.radians(mount_deg))
    fit = calibrate(only_bearings(run_of(truth, turns()))).bearing_fit
    assert fit is not None
    assert (fit.sense.sign, fit.sense.is_folded) == (sign, False)
    error = math.remainder(fit.mount_rad.value - truth.mount_rad, 2.0 * math.pi)
    assert (
        abs(math.degrees(error)) < 4.5
    )  # the compass is out by 2.9 degrees, and a turn is one spot


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("mount_deg", [-50.0, 0.0, 30.0])
def test_what_two_antennas_fold_to_the_front_is_seen(sign: int, mount_deg: float) -> None:
    truth = replace(QUIET, sign=sign, mount_rad=math.radians(mount_deg), is_folded=True)
    done = calibrate(only_bearings(run_of(truth, turns())))
    fit = done.bearing_fit
    assert done.refusals == []
    assert fit is not None
    assert (fit.sense.sign, fit.sense.is_folded) == (sign, True)
    assert math.degrees(abs(fit.mount_rad.value - truth.mount_rad)) < 1.0
    assert fit.behind_share == pytest.approx(0.5, abs=0.1)


def test_an_antenna_that_hears_nothing_behind_has_a_field_of_view() -> None:
    truth = replace(QUIET, view_rad=math.radians(120.0))
    done = calibrate(only_bearings(run_of(truth, turns())))
    fit = done.bearing_fit
    assert done.refusals == []
    assert fit is not None
    assert fit.sense.sign == 1
    assert math.degrees(fit.field_of_view_rad) == pytest.approx(120.0, abs=31.0)


def test_a_circle_tells_the_mount_from_the_compass() -> None:
    truth = replace(QUIET, compass_rad=math.radians(6.0), mount_rad=math.radians(20.0))
    course, blocked = all_tests()
    done = calibrate(simulated(truth, np.random.default_rng(3), course, blocked))
    fit = done.bearing_fit
    assert fit is not None
    assert fit.compass_rad is not None
    assert math.degrees(fit.compass_rad) == pytest.approx(6.0, abs=1.0)
    assert math.degrees(fit.mount_rad.value) == pytest.approx(20.0, abs=1.0)


def test_out_and_back_tells_the_lag_from_the_offset() -> None:
    done = calibrate(only_ranges(run_of(replace(QUIET, lag_s=0.7), out_and_back())))
    assert done.refusals == []
    assert done.lag_s is not None
    assert done.lag_s.value == pytest.approx(0.7, abs=0.02)


def test_stops_alone_tell_the_offset_but_no_lag() -> None:
    run = only_ranges(run_of(replace(QUIET, lag_s=0.4), line()))
    done = calibrate(run)
    assert done.range_fit is not None
    assert done.range_fit.offset_m.value == pytest.approx(1.0, abs=0.1)


def test_a_scale_is_found_where_distances_are_far_apart() -> None:
    done = calibrate(only_ranges(run_of(replace(QUIET, scale=1.03), out_and_back())))
    assert done.range_fit is not None
    assert done.range_fit.is_scale_used
    assert done.range_fit.scale.value == pytest.approx(1.03, abs=0.004)
    assert done.range_fit.offset_m.value == pytest.approx(1.0, abs=0.15)


def test_a_scale_is_held_at_1_where_the_spread_is_too_small() -> None:
    course = line((40.0, 55.0, 70.0, 85.0, 100.0))
    course.go(at(40.0), 4.0)
    done = calibrate(only_ranges(run_of(QUIET, course)))
    assert done.refusals == []
    assert done.range_fit is not None
    assert not done.range_fit.is_scale_used
    assert any("held at 1" in remark for remark in done.remarks)
    assert done.range_fit.offset_m.value == pytest.approx(1.0, abs=0.1)


def test_reflections_do_not_move_the_offset() -> None:
    truth = replace(QUIET, nlos_share=0.4, excess_m=4.0)
    done = calibrate(only_ranges(run_of(truth, out_and_back())))
    assert done.range_fit is not None
    assert done.range_fit.offset_m.value == pytest.approx(1.0, abs=0.1)
    assert done.range_fit.nlos_share.value == pytest.approx(0.37, abs=0.06)
    assert done.range_fit.nlos_excess_m is not None
    assert done.range_fit.nlos_excess_m.value == pytest.approx(4.3, abs=0.6)


def test_a_blocked_run_is_reported_or_found() -> None:
    course, (low_s, high_s) = all_tests()
    run = simulated(QUIET, np.random.default_rng(2), course, (low_s, high_s))
    found = calibrate(run).blocked
    assert found is not None
    assert found.share == pytest.approx(0.8, abs=0.15)
    windows = (RunWindow("blocked", 100.0 + low_s, 100.0 + high_s),)
    blocked = calibrate(replace(run, windows=windows)).blocked
    assert blocked is not None
    assert blocked.share == pytest.approx(0.75, abs=0.1)
    assert blocked.excess_m == pytest.approx(3.3, abs=0.7)


def test_a_sigma_that_the_radio_reports_is_kept_where_it_fits() -> None:
    run = only_ranges(run_of(QUIET, out_and_back()))
    assert calibrate(run).keeps_reported_sigma
    wrong = [replace(m, range_sigma_m=3.0) for m in run.measurements]
    assert not calibrate(replace(run, measurements=wrong)).keeps_reported_sigma


# Refusals, in words.


def refusal(run: CalibrationRun, words: str) -> None:
    done = calibrate(run)
    assert any(words in reason for reason in done.refusals), done.refusals
    assert f"refused: {next(r for r in done.refusals if words in r)}" in verdict(done)


def test_fewer_than_four_distances_are_refused() -> None:
    refusal(only_ranges(run_of(QUIET, line((10.0, 12.0)))), "distances (")


def test_a_spread_too_small_for_the_scale_is_said() -> None:
    done = calibrate(only_ranges(run_of(QUIET, line((20.0, 25.0, 30.0, 35.0, 40.0)))))
    assert any("too small for the scale" in remark for remark in done.remarks)


def test_two_emitters_under_one_name_are_refused() -> None:
    run = only_ranges(run_of(replace(QUIET, nlos_share=0.0), out_and_back()))
    rng = np.random.default_rng(5)
    both = [
        replace(m, range_m=(m.range_m or 0.0) + (6.0 if rng.random() < 0.4 else 0.0))
        for m in run.measurements
    ]
    refusal(replace(run, measurements=both), "two emitters or two paths")


def test_reflections_are_not_taken_for_a_second_emitter() -> None:
    truth = replace(QUIET, nlos_share=0.4, excess_m=5.0)
    for seed in range(5):
        done = calibrate(only_ranges(run_of(truth, out_and_back(), seed)))
        assert done.refusals == []


@pytest.mark.parametrize("lag_s", [-2.2, 2.3])
def test_a_lag_beyond_two_seconds_is_refused(lag_s: float) -> None:
    run = only_ranges(run_of(replace(QUIET, lag_s=0.0), out_and_back()))
    late = [replace(m, measured_at_s=m.measured_at_s + lag_s) for m in run.measurements]
    refusal(replace(run, measurements=late), "clocks disagree")
    run = only_bearings(run_of(replace(QUIET, lag_s=0.0), turns()))
    late = [replace(m, measured_at_s=m.measured_at_s + lag_s) for m in run.measurements]
    refusal(replace(run, measurements=late), "clocks disagree")


def test_bearings_from_anywhere_are_refused() -> None:
    rng = np.random.default_rng(7)
    run = only_bearings(run_of(QUIET, turns()))
    random = [replace(m, bearing_body_rad=rng.uniform(-3.1, 3.1)) for m in run.measurements]
    refusal(replace(run, measurements=random), "does not follow the turn")


def test_a_bearing_that_stands_still_is_refused() -> None:
    run = only_bearings(run_of(QUIET, turns()))
    stuck = [replace(m, bearing_body_rad=0.4) for m in run.measurements]
    refusal(replace(run, measurements=stuck), "does not follow the turn")


def test_bearings_without_a_turn_are_refused() -> None:
    refusal(only_bearings(run_of(QUIET, line())), "turn")


def test_a_folded_antenna_that_looks_sideways_is_refused() -> None:
    truth = replace(QUIET, is_folded=True, mount_rad=math.radians(88.0))
    refusal(only_bearings(run_of(truth, turns())), "faces sideways")


def test_a_vehicle_that_does_not_know_its_place_is_refused() -> None:
    run = run_of(QUIET, out_and_back())
    vague = [TimedPose(p.t_s, p.enu_m, p.yaw_rad, p.roll_rad, p.pitch_rad, 1.5) for p in run.poses]
    refusal(only_ranges(replace(run, poses=vague)), "needs RTK")
    turned = run_of(replace(QUIET, bearing_sigma_rad=0.05), turns())
    vague = [
        TimedPose(p.t_s, p.enu_m, p.yaw_rad, p.roll_rad, p.pitch_rad, 1.5) for p in turned.poses
    ]
    refusal(only_bearings(replace(turned, poses=vague)), "farther away")


def test_one_way_without_a_stop_does_not_tell_offset_from_lag() -> None:
    course = Course([at(5.0)], [0.3])
    course.go(at(100.0), 3.0)
    run = only_ranges(run_of(QUIET, course))
    under_way = [m for m in run.measurements if 103.0 < m.measured_at_s < 128.0]
    refusal(replace(run, measurements=under_way), "offset and lag cannot be separated")


def test_too_few_answers_are_refused() -> None:
    run = run_of(QUIET, line())
    few = replace(run, measurements=run.measurements[::60])
    refusal(only_ranges(few), "only")


def test_answers_without_any_pose_are_refused() -> None:
    run = run_of(QUIET, line())
    far = [replace(m, measured_at_s=m.measured_at_s + 1e4) for m in run.measurements]
    refusal(replace(run, measurements=far), "known vehicle position")


def test_bearings_without_yaw_are_refused() -> None:
    run = run_of(QUIET, turns())
    blind = [TimedPose(p.t_s, p.enu_m, sigma_m=p.sigma_m) for p in run.poses]
    refusal(only_bearings(replace(run, poses=blind)), "no yaw was recorded")


def test_what_is_refused_of_bearings_leaves_the_ranges_usable() -> None:
    rng = np.random.default_rng(7)
    run = run_of(QUIET, out_and_back())
    random = [replace(m, bearing_body_rad=rng.uniform(-3.1, 3.1)) for m in run.measurements]
    done = calibrate(replace(run, measurements=random))
    assert done.has_ranges
    assert not done.has_bearings
    assert "usable: only ranges" in verdict(done)


def measured_by_north(run: CalibrationRun, turned_rad: float, sign: int = 1) -> CalibrationRun:
    kept: list[RangingMeasurement] = []
    rng = np.random.default_rng(9)
    positions = {pose.t_s: pose.enu_m for pose in run.poses}
    times = np.array(list(positions))
    for m in run.measurements:
        east, north, _ = positions[times[int(np.argmin(np.abs(times - m.measured_at_s)))]]
        true = math.atan2(POINT[1] - north, POINT[0] - east)
        said = sign * true + turned_rad + 0.05 * rng.standard_normal()
        kept.append(
            RangingMeasurement(
                7, m.measured_at_s, bearing_enu_rad=math.remainder(said, 2.0 * math.pi)
            )
        )
    return replace(run, measurements=kept)


def test_bearings_by_north_have_an_offset_and_no_sign_to_set() -> None:
    course, _ = all_tests()
    run = measured_by_north(run_of(replace(QUIET, lag_s=0.0), course), -0.1)
    done = calibrate(run)
    assert done.is_by_north
    assert done.refusals == []
    assert done.bearing_fit is not None
    # said is counter-clockwise: what is clockwise of it by 0.1 is a boresight 0.1 the other way
    assert done.bearing_fit.mount_rad.value == pytest.approx(-0.1, abs=0.02)
    assert done.bearing_fit.sigma_rad.value == pytest.approx(0.05, rel=0.25)


def test_bearings_by_north_that_turn_the_other_way_are_refused() -> None:
    course, _ = all_tests()
    run = measured_by_north(run_of(replace(QUIET, lag_s=0.0), course), 0.3, sign=-1)
    refusal(run, "should turn clockwise")


def test_where_one_place_has_most_of_the_variance_there_are_not_as_many_as_there_are() -> None:
    """Twelve positions whose mean is as uncertain either way, by one of them or by all alike."""
    count = 12
    one, all_alike = np.zeros(count), np.tile([-1.0, 1.0], count // 2)
    one[0] = math.sqrt(count / (1.0 - 1.0 / count))
    assert np.var(one) == pytest.approx(np.var(all_alike))
    lonely, even = (ratio_figure(parts, np.ones(count)) for parts in (one, all_alike))
    assert even.half_width == pytest.approx(2.2010 / math.sqrt(count - 1.0), rel=1e-3)
    assert lonely.half_width > 3.0 * even.half_width
