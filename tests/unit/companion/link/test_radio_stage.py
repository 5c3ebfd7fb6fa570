"""The common stage: names, offsets, mounts, clocks, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.domain import Params, RangingMeasurement
from companion.link.interface import RadioSettings, RadioSetup
from companion.link.radio_stage import RadioStage
from companion.radios.decoder import AngleFrame, RadioDecoder, RadioKind, RadioReading, radio_kind
from companion.radios.fields import emitter_name

READING = RadioReading(emitter=7, range_m=42.0)


class Said(RadioDecoder):
    """Decoder that returns configured readings for any bytes."""

    def __init__(self, options: Params | None = None) -> None:
        super().__init__(options)
        self.readings: list[RadioReading] = []
        self.resets = 0

    def feed(self, data: bytes, received_s: float) -> list[RadioReading]:
        del received_s
        if data == b"bug":
            raise IndexError("beyond the end")
        return self.readings

    def reset(self) -> None:
        self.resets += 1


KIND = RadioKind("said", Said, "a test's", "range", "nothing", "udp")


def stage_of(kind: RadioKind = KIND, **settings: Any) -> RadioStage:
    return RadioStage(RadioSetup(kind, RadioSettings(**{"rate_max_hz": None, **settings})))


def measured(stage: RadioStage, *readings: RadioReading, now_s: float = 5.0) -> Any:
    decoder = stage.decoder
    assert isinstance(decoder, Said)
    decoder.readings = list(readings)
    return stage.receive(b"x", now_s)


def one(stage: RadioStage, reading: RadioReading, now_s: float = 5.0) -> RangingMeasurement:
    (measurement,) = measured(stage, reading, now_s=now_s)
    assert isinstance(measurement, RangingMeasurement)
    return measurement


def test_a_range_loses_offset_and_scale_and_its_sigma_the_scale() -> None:
    stage = stage_of(range_offset_m=2.0, range_scale=1.25)
    measurement = one(stage, replace(READING, range_sigma_m=0.5))
    assert measurement.range_m == 32.0
    assert measurement.range_sigma_m == 0.4


@pytest.mark.parametrize(
    ("listed", "printed"),
    [
        ("aa:bb:CC:00:11:22", "AA:BB:CC:00:11:22"),
        ("aa:bb:CC:00:11:22", "aa-bb-cc-00-11-22"),
        ("CC:F9:57:8E:0D:8A", "CCF9578E0D8A"),
        ("ccf9578e0d8a", "CC:F9:57:8E:0D:8A"),
        ("CCF9.578E.0D8A", "CCF9578E0D8A"),
        ("00:11:22:33:44:55", "001122334455"),
        ("11:22:33:44:55:16", "112233445516"),
        ("70-B3-D5-7E-D0-00-00-01", "70b3d57ed0000001"),
    ],
)
def test_a_mac_is_found_in_any_notation(listed: str, printed: str) -> None:
    stage = stage_of(emitters={listed: 3}, unnamed="refuse")
    assert one(stage, replace(READING, emitter=printed)).emitter_id == 3


@pytest.mark.parametrize(("emitter", "number"), [("7", 70), (7, 70), (0x11, 170), ("Tag", 1)])
def test_numbers_are_the_same_in_any_spelling_and_names_are_exact(
    emitter: str | int, number: int
) -> None:
    stage = stage_of(emitters={"7": 70, "0x11": 170, "Tag": 1}, unnamed="refuse")
    assert one(stage, replace(READING, emitter=emitter)).emitter_id == number
    assert measured(stage, replace(READING, emitter="tag")) == []
    assert stage.all_refused == {"emitter is not listed": 1}


def test_an_unnamed_emitter_gets_an_id_that_is_the_same_on_every_radio_and_is_reported_once() -> (
    None
):
    first, second = stage_of(), stage_of()
    measured(second, replace(READING, emitter="another"))
    named = replace(READING, emitter="ski jacket")
    number = one(first, named).emitter_id
    assert one(first, named).emitter_id == one(second, named).emitter_id == number
    assert first.names.texts == [f"emitter `ski jacket` has the id {number}"]


def test_a_number_beyond_16_bits_is_a_name() -> None:
    assert 0 <= one(stage_of(), replace(READING, emitter=2**31)).emitter_id <= 65_535


def test_a_frequency_is_found_within_its_tolerance() -> None:
    stage = stage_of(emitters={"433.92": 4, "434.0": 5}, frequency_tolerance_khz=25.0)
    assert one(stage, replace(READING, emitter="433.9300")).emitter_id == 4
    assert one(stage, replace(READING, emitter="433.9900")).emitter_id == 5
    stray = [one(stage, replace(READING, emitter=name)).emitter_id for name in ("144.39", "144.40")]
    assert stray[0] == stray[1]
    assert stray[0] not in (4, 5)


def test_a_name_of_digits_is_listed_as_it_is_printed() -> None:
    """A tag prints its address in hexadecimal, four digits: `0012` is a name, not twelve."""
    stage = stage_of(emitters={"0012": 3, "00A1": 4, "7": 5})
    printed = [emitter_name(text) for text in ("0012", "00A1", "07")]
    assert [one(stage, replace(READING, emitter=each)).emitter_id for each in printed] == [3, 4, 5]


def test_what_names_no_emitter_is_the_configured_one() -> None:
    assert one(stage_of(emitter=9), replace(READING, emitter=None)).emitter_id == 9


def test_names_without_end_take_no_memory_without_end() -> None:
    stage = stage_of()
    for number in range(1000):
        measured(stage, replace(READING, emitter=f"name {number}"))
    assert stage.all_refused["emitter is not listed"] > 700


@pytest.mark.parametrize(
    ("frame", "said_deg", "body_deg"),
    [(AngleFrame.DEVICE, 20.0, -10.0), (AngleFrame.NOSE, 170.0, -160.0)],
)
def test_a_bearing_is_turned_by_sign_and_mount(
    frame: AngleFrame, said_deg: float, body_deg: float
) -> None:
    stage = stage_of(bearing_sign=-1, bearing_mount_deg=10.0)
    reading = RadioReading(emitter=7, azimuth_rad=math.radians(said_deg), frame=frame)
    measurement = one(stage, reading)
    assert measurement.bearing_body_rad == pytest.approx(math.radians(body_deg))
    assert measurement.bearing_enu_rad is None
    assert not measurement.is_array_angle


def test_a_bearing_by_north_is_neither_turned_nor_mirrored() -> None:
    stage = stage_of(bearing_sign=-1, bearing_mount_deg=10.0, field_of_view_deg=90.0)
    reading = RadioReading(emitter=7, azimuth_rad=0.5 * math.pi, frame=AngleFrame.NORTH)
    measurement = one(stage, reading)
    assert measurement.bearing_enu_rad == pytest.approx(0.0)
    assert measurement.bearing_body_rad is None


def test_the_angles_of_an_array_are_mirrored_but_never_turned() -> None:
    reading = RadioReading(
        emitter=7, azimuth_rad=0.5, elevation_rad=-0.25, frame=AngleFrame.ARRAY, range_m=3.0
    )
    measurement = one(stage_of(bearing_sign=-1, elevation_sign=-1), reading)
    assert measurement.is_array_angle
    assert measurement.bearing_body_rad == -0.5
    assert measurement.elevation_rad == 0.25
    turned = stage_of(bearing_mount_deg=10.0)
    assert one(turned, reading).bearing_body_rad is None
    assert sum(turned.all_refused.values()) == 1


@pytest.mark.parametrize("said_dbm", [127.0, 61.0, -200.0, math.nan])
def test_a_power_that_is_none_is_refused_and_the_range_beside_it_kept(said_dbm: float) -> None:
    stage = stage_of()
    measurement = one(stage, replace(READING, power_dbm=said_dbm))
    assert (measurement.range_m, measurement.power_dbm) == (42.0, None)
    assert stage.all_refused == {"power is not within -174 to 20 dBm": 1}
    assert measured(stage, RadioReading(emitter=7, power_dbm=said_dbm)) == []


def test_a_power_alone_passes_with_its_offset() -> None:
    assert one(stage_of(), RadioReading(emitter=7, power_dbm=-71.0)).power_dbm == -71.0
    relative = stage_of(power_offset_db=-150.0)
    assert one(relative, RadioReading(emitter=7, power_dbm=21.5)).power_dbm == -128.5


def test_a_power_beside_a_refused_range_is_not_used_alone() -> None:
    stage = stage_of()
    assert measured(stage, replace(READING, range_m=0.0, power_dbm=-71.0)) == []
    assert stage.all_refused == {"range of exactly 0: nothing measured": 1}


def test_names_that_are_not_listed_are_kept_with_their_power() -> None:
    stage = stage_of(emitters={"tag": 1}, unnamed="refuse")
    for name, power_dbm in (("a", -71.0), ("b\n", None), ("a", -70.0)):
        assert measured(stage, RadioReading(emitter=name, range_m=3.0, power_dbm=power_dbm)) == []
    assert stage.unlisted == {"a": -70.0, "b?": None}


def test_half_of_a_reading_is_kept_where_the_other_half_is_refused() -> None:
    stage = stage_of(field_of_view_deg=120.0, range_max_m=100.0)
    behind = replace(READING, azimuth_rad=2.0)
    assert one(stage, behind).range_m == 42.0
    far = replace(READING, azimuth_rad=1.0, range_m=200.0)
    assert one(stage, far).range_m is None
    assert measured(stage, replace(far, azimuth_rad=None)) == []
    assert stage.all_refused == {"outside field_of_view_deg": 1, "range above range_max_m": 2}


@pytest.mark.parametrize("said", [math.nan, math.inf, -0.1])
def test_a_range_that_is_none_is_refused(said: float) -> None:
    assert measured(stage_of(), replace(READING, range_m=said)) == []


@pytest.mark.parametrize("said", [math.nan, math.inf, 45.0])
def test_a_bearing_that_is_no_angle_is_refused(said: float) -> None:
    assert measured(stage_of(), RadioReading(emitter=7, azimuth_rad=said)) == []


def test_sigmas_come_from_the_radio_or_the_settings_and_grow_with_less_quality() -> None:
    stage = stage_of(
        range_sigma_m=2.0, bearing_sigma_deg=5.0, sigma_factors=((0.0, 3.0), (0.5, 1.0))
    )
    said = replace(READING, azimuth_rad=0.1, quality=0.6)
    assert one(stage, said).range_sigma_m == 2.0
    assert one(stage, said).bearing_sigma_rad == pytest.approx(math.radians(5.0))
    worse = replace(said, quality=0.2, range_sigma_m=0.5)
    assert one(stage, worse).range_sigma_m == 1.5
    assert one(stage_of(), said).range_sigma_m is None


def test_too_little_quality_is_refused() -> None:
    stage = stage_of(quality_min=0.3)
    assert measured(stage, replace(READING, quality=0.2)) == []
    assert one(stage, replace(READING, quality=None)).range_m == 42.0


def test_a_reading_is_dated_by_the_devices_clock_its_age_and_the_lag() -> None:
    stage = stage_of(lag_s=0.2)
    one(stage, replace(READING, device_time_s=100.0), now_s=5.0)
    measurement = one(stage, replace(READING, device_time_s=100.5, age_s=0.1), now_s=5.9)
    assert measurement.measured_at_s == pytest.approx(5.2, abs=1e-3)
    assert measurement.stamp_us == 100_500_000


def test_arrival_counts_without_a_clock_and_where_it_is_asked_for() -> None:
    assert one(stage_of(), replace(READING, age_s=0.5)).measured_at_s == 4.5
    stage = stage_of(clock="arrival")
    one(stage, replace(READING, device_time_s=1.0))
    assert one(stage, replace(READING, device_time_s=1.1), now_s=9.0).measured_at_s == 9.0


@pytest.mark.parametrize("wrap_s", [1.0, 17.2, 65.536])
def test_a_clock_that_wraps_goes_on(wrap_s: float) -> None:
    stage = stage_of(replace(KIND, clock_wrap_s=wrap_s))
    for tick in range(2000):
        now_s = 5.0 + 0.1 * tick
        reading = replace(READING, device_time_s=now_s % wrap_s, range_m=40.0 + tick)
        late_s = 0.02 * (tick % 3)
        measurement = one(stage, reading, now_s=now_s + late_s)
        assert measurement.measured_at_s == pytest.approx(now_s, abs=0.01)
    assert stage.clock.restarts == 0


def test_a_wrap_in_silence_is_one_too() -> None:
    stage = stage_of(replace(KIND, clock_wrap_s=10.0))
    one(stage, replace(READING, device_time_s=9.0), now_s=9.0)
    assert one(stage, replace(READING, device_time_s=2.0), now_s=32.0).measured_at_s == 32.0


def test_a_device_that_restarted_is_believed_after_a_moment() -> None:
    stage = stage_of()
    for tick in range(50):
        one(stage, replace(READING, device_time_s=500.0 + 0.1 * tick), now_s=0.1 * tick)
    for tick in range(20):
        now_s = 10.0 + 0.1 * tick
        measurement = one(stage, replace(READING, device_time_s=0.1 * tick), now_s=now_s)
    assert measurement.measured_at_s == pytest.approx(now_s, abs=1e-3)
    assert stage.clock.restarts == 1


def test_a_page_that_stands_still_is_measured_once() -> None:
    stage = stage_of()
    page = replace(READING, device_time_s=3.0)
    assert len(measured(stage, page)) == 1
    assert measured(stage, page) == []
    assert len(measured(stage, replace(page, device_time_s=4.0))) == 1
    assert stage.all_refused == {"seen before": 1}


def test_a_range_is_stuck_after_as_many_equal_ones_as_are_allowed() -> None:
    stage = stage_of(stuck_after=3)
    assert [len(measured(stage, READING, now_s=5.0 + n)) for n in range(5)] == [1, 1, 1, 0, 0]
    assert len(measured(stage, replace(READING, range_m=42.1), now_s=10.0)) == 1
    assert len(measured(stage, READING)) == 1


def test_an_emitter_is_measured_as_often_as_is_allowed_by_the_times_of_measurement() -> None:
    stage = stage_of(rate_max_hz=10.0)
    kept = 0
    for tick in range(400):
        time_s = 0.005 * tick
        reading = replace(READING, device_time_s=100.0 + time_s, range_m=40.0 + tick)
        kept += len(measured(stage, reading, now_s=5.0 + time_s))
    assert 19 <= kept <= 22
    assert stage.thinned == 400 - kept
    assert stage.all_refused == {}
    other = replace(READING, emitter=8, device_time_s=102.0)
    assert len(measured(stage, other, now_s=7.0)) == 1


def test_a_burst_of_what_was_measured_earlier_is_not_thinned() -> None:
    stage = stage_of(rate_max_hz=10.0)
    ages = [replace(READING, age_s=0.1 * (9 - n), range_m=40.0 + n) for n in range(10)]
    assert len(measured(stage, *ages)) == 10


def test_the_default_lets_ten_a_second_through_whole() -> None:
    stage = stage_of(rate_max_hz=RadioSettings().rate_max_hz)
    for tick in range(600):
        late_s = 0.03 * (tick % 2)
        reading = replace(READING, range_m=1.0 + tick)
        assert len(measured(stage, reading, now_s=0.1 * tick + late_s)) == 1


def test_an_old_reading_is_refused() -> None:
    stage = stage_of(max_age_s=0.5)
    assert measured(stage, replace(READING, age_s=0.6)) == []
    assert len(measured(stage, replace(READING, age_s=0.4))) == 1


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be"])
def test_text_in_utf_16_is_called_that(encoding: str) -> None:
    stage = RadioStage(RadioSetup(radio_kind("esp32_ftm"), RadioSettings()))
    stage.receive("I (5) ftm: Estimated RTT - 33 nSec\n".encode(encoding), 0.0)

    assert stage.unrecognised == "text in UTF-16: save or send it as UTF-8"


def test_a_lost_line_resets_the_decoder() -> None:
    stage = stage_of()
    assert stage.receive(b"", 1.0) == []
    assert isinstance(stage.decoder, Said)
    assert stage.decoder.resets == stage.lost == 1


def test_a_decoder_that_fails_ends_no_flight() -> None:
    stage = stage_of()
    assert stage.receive(b"bug", 1.0) == []
    assert stage.all_refused == {"the decoder failed (IndexError)": 1}
    assert len(measured(stage, READING)) == 1


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"range_min_m": 5.0, "range_max_m": 5.0}, "range_max_m: "),
        ({"sigma_factors": ((0.5, 1.0), (0.5, 2.0))}, "sigma_factors: "),
        ({"emitters": {"aa:bb:cc:dd:ee:ff": 1, "AA-BB-CC-DD-EE-FF": 2}}, "emitters: "),
        ({"emitters": {"tag": 1}, "frequency_tolerance_khz": 5.0}, "emitters: "),
    ],
)
def test_settings_that_contradict_themselves_are_refused(
    settings: dict[str, Any], key: str
) -> None:
    with pytest.raises(ValueError, match=f"^{key}"):
        RadioSettings(**settings)
