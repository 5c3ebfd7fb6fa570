"""A radio in the field: spatially correlated errors, burial, steps, losses and antennas."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from companion.domain import PositionEnu, RangingMeasurement
from sim_link.world.environment import (
    ChannelParams,
    Emitter,
    EmitterParams,
    Environment,
    FieldChannelParams,
    LossParams,
    ObstacleParams,
    ShadowParams,
)
from sim_link.world.field_radio import FieldRadio, Measures, burial_excess_m, link_margin_db
from sim_link.world.line_of_sight import walls_between
from sim_link.world.point_mass import LEVEL, EulerAngles
from sim_link.world.radio_channel import AntennaModelParams, RadioChannel

EMITTER = Emitter(EmitterParams())
HERE = (10.0, 10.0, 20.0)
QUIET = FieldChannelParams(
    range_offset_m=0.0,
    bearing_offset_deg=0.0,
    p_nlos=0.0,
    range_sigma_m=0.0,
    bearing_sigma_deg=0.0,
)
PLANAR = AntennaModelParams(kind="planar")
BLOCK = ObstacleParams(
    corners_enu_m=((30.0, 30.0), (45.0, 30.0), (45.0, 60.0), (30.0, 60.0)), height_m=25.0
)
CALM = LossParams(shadow_sigma_db=0.0, fading_sigma_db=0.0)


def with_(params: FieldChannelParams = QUIET, **changes: object) -> FieldChannelParams:
    return msgspec.structs.replace(params, **changes)


def radio(
    params: ChannelParams,
    antenna: AntennaModelParams | None = None,
    *,
    seed: int = 3,
    measures: Measures = "both",
    obstacles: Sequence[ObstacleParams] = (),
) -> FieldRadio:
    environment = Environment(obstacles) if obstacles else None
    rng = np.random.default_rng(seed)
    return FieldRadio(params, rng, environment, antenna or AntennaModelParams(), measures)


def heard(
    instrument: FieldRadio, positions: Sequence[PositionEnu], attitude: EulerAngles = LEVEL
) -> list[RangingMeasurement]:
    answers = (instrument.hear(EMITTER, position, 0.0, attitude) for position in positions)
    return [answer for answer in answers if answer is not None]


def ranges_m(instrument: FieldRadio, positions: Sequence[PositionEnu]) -> list[float]:
    return [each.range_m for each in heard(instrument, positions) if each.range_m is not None]


def along(step_m: float, count: int, up_m: float = 20.0) -> list[PositionEnu]:
    return [(step_m * index, 0.0, up_m) for index in range(count)]


def lag_correlation(values: Sequence[float], lag: int) -> float:
    return float(np.corrcoef(values[:-lag], values[lag:])[0, 1])


def test_received_power_is_the_sensitivity_plus_the_margin_in_whole_steps() -> None:
    loss = LossParams(sensitivity_dbm=-97.0, shadow_sigma_db=0.0, fading_sigma_db=0.0)
    params = FieldChannelParams(p_nlos=0.0, loss=loss)
    radio = FieldRadio(params, np.random.default_rng(1), measures="power")
    emitter = Emitter(EmitterParams(position_enu_m=(0.0, 0.0)))
    radio.prepare(emitter)
    powers = [radio.hear(emitter, (0.0, east_m, 0.0), 0.0) for east_m in (15.0, 150.0 / 4.0)]
    assert [None if m is None else (m.range_m, m.power_dbm) for m in powers] == [
        (None, -77.0),
        (None, -85.0),
    ]
    assert radio.hear(emitter, (0.0, 151.0, 0.0), 0.0) is None


def test_by_default_it_is_the_papers_channel_to_the_last_bit() -> None:
    plain = RadioChannel(ChannelParams(), np.random.default_rng(3), Environment([BLOCK]))
    field = radio(ChannelParams(), obstacles=[BLOCK])
    leaning = EulerAngles(0.2, 0.1, 1.0)
    for position in along(1.0, 100):
        assert field.hear(EMITTER, position, 0.5, leaning) == plain.measure(EMITTER, position, 0.5)


def test_what_the_field_adds_draws_from_a_generator_of_its_own() -> None:
    plain, field = radio(ChannelParams()), radio(FieldChannelParams(range_sigma_growth=1e-12))
    positions = along(1.0, 50)
    assert ranges_m(field, positions) == pytest.approx(ranges_m(plain, positions), abs=1e-6)


OBSTRUCTED = with_(p_nlos=0.7, range_bias_mean_m=8.0, correlation_m=6.0)


def excesses_m(params: FieldChannelParams, step_m: float, count: int) -> list[float]:
    positions = along(step_m, count)
    measured = ranges_m(radio(params), positions)
    return [m - EMITTER.slant_range_m(p) for m, p in zip(measured, positions, strict=True)]


def test_what_stays_with_the_place_has_the_papers_distribution() -> None:
    found = np.array(excesses_m(OBSTRUCTED, 30.0, 6000))  # positions far apart: as good as new
    longer = found[found > 1e-9]
    assert len(longer) / len(found) == pytest.approx(0.7, abs=0.02)
    assert longer.mean() == pytest.approx(8.0, rel=0.04)
    assert longer.std() == pytest.approx(8.0, rel=0.06)
    assert found.min() >= -1e-9


def test_a_hundred_ranges_from_one_spot_are_one_opinion() -> None:
    hovering = ranges_m(radio(OBSTRUCTED), [HERE] * 100)
    assert np.ptp(hovering) == pytest.approx(0.0, abs=1e-9)
    new = ranges_m(radio(with_(OBSTRUCTED, correlation_m=0.0)), [HERE] * 100)
    assert np.std(new) > 4.0


@pytest.mark.slow
def test_the_excess_forgets_itself_over_its_correlation_length() -> None:
    always = with_(OBSTRUCTED, p_nlos=1.0)
    found = excesses_m(always, 1.0, 40_000)
    assert lag_correlation(found, 6) == pytest.approx(math.exp(-1.0), abs=0.06)
    assert lag_correlation(found, 2) == pytest.approx(math.exp(-1.0 / 3.0), abs=0.06)
    assert lag_correlation(found, 60) == pytest.approx(0.0, abs=0.08)


def test_obstruction_stays_as_well() -> None:
    found = [excess > 1e-9 for excess in excesses_m(OBSTRUCTED, 0.5, 20_000)]
    changes = np.mean(np.diff(np.array(found, int)) != 0)
    assert changes < 0.2  # 0.42 of draws that know nothing of each other
    assert lag_correlation([float(each) for each in found], 1) > 0.5


def test_a_bend_stays_too_and_only_where_it_is_obstructed() -> None:
    params = with_(OBSTRUCTED, bearing_bias_sigma_deg=5.0)
    said = heard(radio(params, PLANAR), [HERE] * 50)
    assert len({each.bearing_body_rad for each in said}) == 1
    open_path = heard(radio(with_(params, p_nlos=0.0), PLANAR), [HERE])[0].bearing_body_rad
    assert open_path == pytest.approx(math.radians(45.0))


def test_a_shadow_remembers_for_itself() -> None:
    always = with_(OBSTRUCTED, p_nlos=0.0)
    shaded = ranges_m(radio(always, obstacles=[BLOCK]), [(10.0, 45.0, 5.0)] * 20)
    assert np.ptp(shaded) == pytest.approx(0.0, abs=1e-9)
    assert shaded[0] > EMITTER.slant_range_m((10.0, 45.0, 5.0))


def test_preparing_leaves_no_memory() -> None:
    one, other = radio(OBSTRUCTED), radio(OBSTRUCTED)
    one.prepare(EMITTER)
    assert ranges_m(one, along(1.0, 20)) == ranges_m(other, along(1.0, 20))


def test_ranges_come_in_steps() -> None:
    coarse = radio(with_(range_step_m=39.0))
    assert ranges_m(coarse, along(10.0, 30)) == pytest.approx(
        [max(0.01, 39.0 * round(EMITTER.slant_range_m(p) / 39.0)) for p in along(10.0, 30)]
    )


def test_noise_grows_with_the_range() -> None:
    params = with_(range_sigma_m=0.5, range_sigma_growth=0.01)
    for distance_m in (10.0, 150.0):
        position = (50.0 - distance_m, 50.0, 0.0)
        found = ranges_m(radio(params), [position] * 5000)
        assert np.std(found) == pytest.approx(math.hypot(0.5, 0.01 * distance_m), rel=0.04)


def test_it_tells_the_figures_of_the_data_sheet() -> None:
    params = with_(range_sigma_m=0.5, range_sigma_growth=0.01, bearing_sigma_deg=2.0)
    (said,) = heard(radio(params, PLANAR), [HERE])
    assert (said.range_sigma_m, said.bearing_sigma_rad) == (0.5, math.radians(2.0))
    antenna = msgspec.structs.replace(PLANAR, sigma_deg=4.0)
    assert heard(radio(params, antenna), [HERE])[0].bearing_sigma_rad == math.radians(4.0)


def test_a_slab_delays_by_its_index() -> None:
    assert burial_excess_m(1.5, 7.0, 1.0) == pytest.approx(1.5 * (math.sqrt(7.0) - 1.0))
    assert burial_excess_m(1.5, 7.0, 0.0) == pytest.approx(1.5 * math.sqrt(6.0))
    assert burial_excess_m(1.5, 1.0, 0.3) == pytest.approx(0.0, abs=1e-12)
    above = ranges_m(radio(with_(burial_m=1.5)), [(50.0, 50.0, 20.0)])
    assert above == pytest.approx([20.0 + 1.5 * (math.sqrt(7.0) - 1.0)])


@given(st.floats(1.0, 30.0), st.floats(0.0, 1.0))
@example(1.0, 1.6271176432212397e-09)
def test_its_excess_is_bounded_and_grows_off_the_vertical(permittivity: float, up: float) -> None:
    excess = burial_excess_m(1.0, permittivity, up)
    low, high = math.sqrt(permittivity) - 1.0, math.sqrt(permittivity - 1.0)
    assert low - 1e-9 <= excess <= high + 1e-9


def test_half_of_the_packets_are_heard_at_the_half_range() -> None:
    loss = LossParams(half_range_m=40.0)
    for distance_m, share in ((10.0, 1.0), (40.0, 0.5), (160.0, 0.0)):
        position = (50.0 - distance_m, 50.0, 0.0)
        count = len(heard(radio(with_(loss=loss)), [position] * 3000))
        assert count / 3000 == pytest.approx(share, abs=0.03)


def test_shadowing_stays_with_the_place() -> None:
    """At the half range and without fading a spot is heard always or never."""
    loss = LossParams(half_range_m=40.0, fading_sigma_db=0.0)
    spots = [
        len(heard(radio(with_(loss=loss, correlation_m=6.0), seed=seed), [(10.0, 50.0, 0.0)] * 20))
        for seed in range(40)
    ]
    assert set(spots) == {0, 20}


@pytest.mark.parametrize(
    ("slant_m", "walls", "body_down", "margin_db"),
    [
        (100.0, 0, 0.0, 0.0),
        (10.0, 0, 0.0, 30.0),
        (100.0, 2, 0.0, -14.0),
        (100.0, 0, 1.0, -20.0),  # straight below: the whole null
        (100.0, 0, math.sqrt(0.5), -3.0),
    ],
)
def test_the_margin_adds_up(slant_m: float, walls: int, body_down: float, margin_db: float) -> None:
    loss = LossParams(half_range_m=100.0, exponent=3.0, wall_db=7.0, null_depth_db=20.0)
    assert link_margin_db(loss, slant_m, walls, body_down) == pytest.approx(margin_db, abs=0.02)


def test_a_dipole_hears_nothing_straight_below_until_it_leans() -> None:
    loss = msgspec.structs.replace(CALM, half_range_m=40.0, null_depth_db=30.0)
    above = [(50.0, 50.0, 20.0)]
    instrument = radio(with_(loss=loss))
    assert heard(instrument, above) == []
    assert len(heard(instrument, above, EulerAngles(roll_rad=1.0))) == 1


def test_walls_swallow_packets() -> None:
    loss = msgspec.structs.replace(CALM, half_range_m=100.0, wall_db=12.0)
    behind, beside = (10.0, 45.0, 5.0), (50.0, 10.0, 5.0)
    instrument = radio(with_(loss=loss), obstacles=[BLOCK])
    assert heard(instrument, [behind]) == []
    assert len(heard(instrument, [beside])) == 1


def test_walls_are_counted() -> None:
    edges = Environment([BLOCK]).edges
    assert walls_between(*EMITTER.position_enu_m, 10.0, 45.0, 5.0, edges) == 2
    assert walls_between(*EMITTER.position_enu_m, 50.0, 10.0, 5.0, edges) == 0
    inside = (40.0, 45.0, 1.0)
    assert walls_between(*inside, 60.0, 45.0, 1.0, edges) == 1
    assert walls_between(*inside, 40.0, 45.0, 90.0, edges) == 1  # through the roof


def test_gross_errors_come_from_anywhere_for_a_while() -> None:
    params = with_(p_gross=0.3, gross_correlation_m=4.0)
    said = [each.bearing_body_rad for each in heard(radio(params, PLANAR), along(20.0, 4000))]
    truth = [0.5 * math.pi - EMITTER.bearing_enu_rad(position) for position in along(20.0, 4000)]
    off = np.array(
        [math.remainder((b or 0.0) - t, math.tau) for b, t in zip(said, truth, strict=True)]
    )
    gross = off[np.abs(off) > 1e-6]
    assert len(gross) / len(off) == pytest.approx(0.3, abs=0.03)
    assert np.histogram(gross, 4, (-math.pi, math.pi))[0] / len(gross) == pytest.approx(
        0.25, abs=0.05
    )
    still = heard(radio(params, PLANAR, seed=5), [HERE] * 30)
    assert len({each.bearing_body_rad for each in still}) == 1


def test_an_ideal_antenna_has_gross_errors_in_azimuth() -> None:
    params = with_(p_gross=1.0, gross_correlation_m=0.0)
    said = [each.bearing_enu_rad or 0.0 for each in heard(radio(params), [HERE] * 2000)]
    assert np.std(said) == pytest.approx(math.pi / math.sqrt(3.0), rel=0.05)


@pytest.mark.parametrize("horizontal_m", [40.0, 10.0, 5.0])
def test_a_planar_array_tells_the_azimuth_worse_from_above(horizontal_m: float) -> None:
    params = with_(bearing_sigma_deg=2.0)
    position = (50.0 - horizontal_m, 50.0, 20.0)
    said = heard(radio(params, PLANAR), [position] * 6000)
    bearings = np.degrees([each.bearing_body_rad or 0.0 for each in said])
    slant_m = math.hypot(horizontal_m, 20.0)
    assert bearings.std() == pytest.approx(2.0 * slant_m / horizontal_m, rel=0.06)


def test_an_offset_is_counter_clockwise_for_every_antenna() -> None:
    params = with_(bearing_offset_deg=-3.0)
    (ideal,), (planar,) = heard(radio(params), [HERE]), heard(radio(params, PLANAR), [HERE])
    assert ideal.bearing_enu_rad == pytest.approx(math.radians(42.0))
    assert planar.bearing_body_rad == pytest.approx(math.radians(48.0))


def test_the_attitude_is_in_the_angle() -> None:
    (said,) = heard(radio(QUIET, PLANAR), [HERE], EulerAngles(yaw_rad=math.radians(30.0)))
    assert said.bearing_body_rad == pytest.approx(math.radians(15.0))
    assert (said.bearing_enu_rad, said.is_array_angle) == (None, False)


def test_an_obstacle_pulls_the_azimuth() -> None:
    environment = Environment([BLOCK], ShadowParams(bearing_bias_sigma_deg=0.0, correlation_m=0.0))
    instrument = FieldRadio(QUIET, np.random.default_rng(1), environment, PLANAR)
    (said,) = heard(instrument, [(10.0, 20.0, 5.0)])
    expected = 0.5 * math.pi - math.atan2(10.0, 35.0)  # to the south-east corner
    assert said.bearing_body_rad == pytest.approx(expected, abs=2e-3)


def test_a_radio_measures_what_it_can() -> None:
    (only_range,) = heard(radio(QUIET, measures="range"), [HERE])
    assert (only_range.bearing_enu_rad, only_range.bearing_sigma_rad) == (None, None)
    (only_bearing,) = heard(radio(QUIET, measures="bearing"), [HERE])
    assert (only_bearing.range_m, only_bearing.range_sigma_m) == (None, None)


def test_beyond_its_field_of_view_a_radio_still_tells_the_range() -> None:
    narrow = AntennaModelParams(kind="line", field_of_view_deg=60.0)
    (said,) = heard(radio(QUIET, narrow), [HERE], EulerAngles(yaw_rad=math.radians(120.0)))
    assert said.range_m is not None
    assert (said.bearing_body_rad, said.is_array_angle) == (None, False)
    assert heard(radio(QUIET, narrow, measures="bearing"), [HERE], EulerAngles(yaw_rad=2.0)) == []


def test_two_axes_tell_both_angles() -> None:
    down = AntennaModelParams(kind="two_axis", mount_deg=(0.0, -90.0, 0.0))
    (said,) = heard(radio(with_(bearing_sigma_deg=3.0), down), [HERE])
    assert said.is_array_angle
    assert said.elevation_sigma_rad == said.bearing_sigma_rad == math.radians(3.0)
    assert math.sin(said.bearing_body_rad or 0.0) == pytest.approx(40.0 / 60.0, abs=0.2)
    assert math.sin(said.elevation_rad or 0.0) == pytest.approx(40.0 / 60.0, abs=0.2)
