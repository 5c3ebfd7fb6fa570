"""An emulator's output is decoded to the last step of the format.

The two were written from the same description and share nothing else: where they agree on what a
field means, both have understood it, or both have not. The vectors are the judge of that.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from companion.domain import RangingMeasurement
from companion.geometry.coordinates import wrap_pi
from companion.link.radio_stage import RadioStage
from companion.radios.power_scans import MIN_DBM
from sim_link.emulators.catalogue import EMULATORS, make_emulator
from sim_link.emulators.emulator import Answer, Round
from tests.radio_formats import ALL, FORMAT_OF, POWERS, Format

EMITTER = 7
ROUNDS = 300
NEAR_M, FAR_M = 0.5, 400.0
FIELD_RAD = math.radians(59.0)
SLACK = 1.0 + 1e-6
CLOCK_S = 100.0


def formats(*needed: str) -> list[object]:
    """Return all formats with a field of a measurement."""
    chosen = [each for each in ALL if all(getattr(each, name) for name in needed)]
    return [pytest.param(each, id=each.name) for each in chosen]


def drawn(rng: np.random.Generator, sent_at_s: float, *, is_array: bool) -> RangingMeasurement:
    azimuth_rad, elevation_rad = rng.uniform(-FIELD_RAD, FIELD_RAD, 2).tolist()
    return RangingMeasurement(
        EMITTER,
        sent_at_s,
        float(rng.uniform(NEAR_M, FAR_M)),
        float(rng.uniform(0.6, 3.0)),
        bearing_body_rad=azimuth_rad,
        bearing_sigma_rad=0.1,
        elevation_rad=elevation_rad,
        elevation_sigma_rad=0.1,
        is_array_angle=is_array,
        quality=float(rng.uniform(0.4, 1.0)),
        power_dbm=float(rng.uniform(MIN_DBM, -30.0)),
    )


def said(
    format_: Format, rounds: int = ROUNDS, clock_s: float = CLOCK_S
) -> tuple[list[RangingMeasurement], list[tuple[bytes, float]]]:
    """Return the measurements, and the bytes printed of them with their times."""
    rng = np.random.default_rng(11)
    radio = make_emulator(format_.name, 1, clock_s)
    measured, printed = [], [(radio.banner, 0.0)]
    for number in range(rounds):
        sent_at_s = 1.0 + 0.2 * number + float(rng.uniform(0.0, 0.1))
        each = drawn(rng, sent_at_s, is_array=radio.antenna in ("line", "two_axis"))
        measured.append(each)
        printed.append((radio.say(Round(sent_at_s, (Answer(EMITTER, each),))), sent_at_s))
    return measured, printed


def read(format_: Format, printed: list[tuple[bytes, float]]) -> list[RangingMeasurement]:
    stage = RadioStage(format_.setup(EMITTER))
    return [m for data, now_s in printed for m in stage.receive(data, now_s) if data]


def both(format_: Format) -> list[tuple[RangingMeasurement, RangingMeasurement]]:
    measured, printed = said(format_)
    got = read(format_, printed)
    assert len(got) == len(measured)
    return list(zip(measured, got, strict=True))


def test_every_emulator_has_a_decoder() -> None:
    assert {each.name for each in ALL} == set(EMULATORS)


@pytest.mark.parametrize("format_", formats("power_db"))
def test_received_powers_come_back(format_: Format) -> None:
    for measured, got in both(format_):
        assert got.power_dbm is not None
        assert measured.power_dbm is not None
        assert abs(got.power_dbm - measured.power_dbm) <= SLACK * (format_.power_db or 0.0)


@pytest.mark.parametrize("format_", formats("range_m"))
def test_ranges_come_back(format_: Format) -> None:
    for measured, got in both(format_):
        assert got.range_m is not None
        assert measured.range_m is not None
        assert got.emitter_id == EMITTER
        assert abs(got.range_m - measured.range_m) <= SLACK * (format_.range_m or 0.0)


@pytest.mark.parametrize("format_", formats("azimuth_deg"))
def test_azimuths_come_back_with_their_sign(format_: Format) -> None:
    for measured, got in both(format_):
        assert got.bearing_body_rad is not None
        assert measured.bearing_body_rad is not None
        assert measured.range_m is not None
        off_deg = math.degrees(wrap_pi(got.bearing_body_rad - measured.bearing_body_rad))
        assert abs(off_deg) <= SLACK * format_.azimuth_step_deg(measured.range_m)


@pytest.mark.parametrize("format_", formats("elevation_deg"))
def test_elevations_come_back_with_their_sign(format_: Format) -> None:
    for measured, got in both(format_):
        assert got.elevation_rad is not None
        assert measured.elevation_rad is not None
        off_deg = math.degrees(got.elevation_rad - measured.elevation_rad)
        assert abs(off_deg) <= SLACK * (format_.elevation_deg or 0.0)


@pytest.mark.parametrize("format_", [each for each in ALL], ids=lambda each: str(each.name))
def test_what_a_format_does_not_tell_is_missing_and_never_zero(format_: Format) -> None:
    for _, got in both(format_)[:20]:
        assert (got.range_m is None) == (format_.range_m is None)
        assert (got.bearing_body_rad is None) == (format_.azimuth_deg is None)
        assert (got.elevation_rad is None) == (format_.elevation_deg is None)
        assert (got.power_dbm is None) == (format_.power_db is None)


@pytest.mark.parametrize("format_", formats("sigma_m"))
def test_sigmas_come_back(format_: Format) -> None:
    for measured, got in both(format_):
        assert got.range_sigma_m == pytest.approx(measured.range_sigma_m, abs=format_.sigma_m)


@pytest.mark.parametrize("format_", formats("has_quality"))
def test_qualities_come_back_in_steps(format_: Format) -> None:
    qualities = [(measured.quality, got.quality) for measured, got in both(format_)]
    for measured, got in qualities:
        assert got == pytest.approx(measured, abs=0.0626)
    assert len({got for _, got in qualities}) > 3


@pytest.mark.parametrize("format_", formats("time_s"))
def test_times_come_back_by_the_radios_own_clock(format_: Format) -> None:
    """The time between two measurements is the true one, however late the lines arrive."""
    measured, printed = said(format_)
    late = [(data, now_s + 0.07 * (number % 3)) for number, (data, now_s) in enumerate(printed)]
    got = read(format_, late)
    steps = [b.measured_at_s - a.measured_at_s for a, b in pairwise(measured)]
    seen = [b.measured_at_s - a.measured_at_s for a, b in pairwise(got)]
    assert format_.time_s is not None
    for step, was in list(zip(steps, seen, strict=True))[20:]:
        assert was == pytest.approx(step, abs=2.0 * format_.time_s + 1e-3)


@pytest.mark.parametrize(
    ("name", "wrap_s"),
    [
        ("nlink_aoa", 2.0**32 / 1e3),
        ("nlink_node5", 2.0**32 / 1e3),
        ("nlink_iot", 2.0**32 / 1e3),
        ("esp32_ftm", 2.0**32 / 1e3),
    ],
)
def test_a_clock_that_starts_again_makes_no_difference(name: str, wrap_s: float) -> None:
    format_ = FORMAT_OF[name]
    measured, printed = said(format_, clock_s=wrap_s - 30.0)
    got = read(format_, printed)
    assert len(got) == len(measured)
    for before, after in zip(measured, got, strict=True):
        assert after.measured_at_s == pytest.approx(before.measured_at_s, abs=0.01)


@pytest.mark.parametrize("format_", [each for each in ALL], ids=lambda each: str(each.name))
def test_who_does_not_answer_has_no_reading(format_: Format) -> None:
    measured, printed = said(format_, 3)
    radio = make_emulator(format_.name, 1, CLOCK_S)
    silence = radio.say(Round(9.0, (Answer(EMITTER),)))
    stage = RadioStage(format_.setup(EMITTER))
    heard = [m for data, now_s in printed if data for m in stage.receive(data, now_s)]
    assert len(heard) == len(measured)
    after = stage.receive(silence, 9.0) if silence else []
    assert [m for m in after if m.range_m is not None or format_ in POWERS] == []


MANY = [each for each in ALL if each.kind.most >= 4]


@pytest.mark.parametrize("format_", MANY, ids=lambda each: str(each.name))
def test_emitters_are_distinguished(format_: Format) -> None:
    ids = (1, 2, 3, 5)
    radio = make_emulator(format_.name, 1, CLOCK_S)
    names = {radio.name_on_wire(emitter_id): emitter_id for emitter_id in ids}
    stage = RadioStage(format_.setup(1, emitters=names))
    rng = np.random.default_rng(5)
    is_array = radio.antenna in ("line", "two_axis")
    measured = {i: replace(drawn(rng, 2.0, is_array=is_array), emitter_id=i) for i in ids}
    stage.receive(radio.banner or b"\n", 0.0)
    asked = Round(2.0, (*(Answer(i, measured[i]) for i in ids[:3]), Answer(5)))
    got = stage.receive(radio.say(asked), 2.0)
    assert sorted(each.emitter_id for each in got) == [1, 2, 3]
    for each in got:
        expected = measured[each.emitter_id]
        if format_.range_m is not None:
            assert each.range_m == pytest.approx(expected.range_m, abs=SLACK * format_.range_m)


def test_a_program_that_prints_json_says_of_an_arcsine_that_it_is_one() -> None:
    asked = drawn(np.random.default_rng(3), 1.0, is_array=True)
    printed = make_emulator("ndjson", 1, 0.0).encode(Round(1.0, (Answer(EMITTER, asked),)))
    (got,) = read(FORMAT_OF["ndjson"], [(printed, 1.0)])
    assert got.is_array_angle
    assert got.bearing_body_rad == pytest.approx(asked.bearing_body_rad, abs=1e-9)
    assert got.elevation_rad == pytest.approx(asked.elevation_rad, abs=1e-9)


def test_a_board_turns_two_arcsines_into_azimuth_and_elevation() -> None:
    right, up = 0.5, -0.6
    ahead = math.sqrt(1.0 - right * right - up * up)
    asked = RangingMeasurement(
        EMITTER,
        1.0,
        bearing_body_rad=math.asin(right),
        elevation_rad=math.asin(up),
        is_array_angle=True,
    )
    printed = make_emulator("uudf", 1, 0.0).encode(Round(1.0, (Answer(EMITTER, asked),)))
    half_rad = math.radians(0.51)
    (got,) = read(FORMAT_OF["uudf"], [(printed, 1.0)])
    assert got.bearing_body_rad == pytest.approx(math.atan2(right, ahead), abs=half_rad)
    assert got.elevation_rad == pytest.approx(math.asin(up), abs=half_rad)
    assert not got.is_array_angle
    back = replace(FORMAT_OF["uudf"], options={"as_arcsines": True})
    (got,) = read(back, [(printed, 1.0)])
    assert got.bearing_body_rad == pytest.approx(math.asin(right), abs=2.0 * half_rad)
    assert got.elevation_rad == pytest.approx(math.asin(up), abs=half_rad)
    assert got.is_array_angle
