from __future__ import annotations

import math

import msgspec
import pytest

from companion.radios.cellular import (
    CellOptions,
    NrOptions,
    OaiDecoder,
    SrsRan4gDecoder,
    SrsRan4gOptions,
    SrsRanDecoder,
    SrsRanOptions,
    step_m,
)

RACH = "RACH:  tti=341, cc=0, pci=1, preamble=12, offset=3, temp_crnti=0x46\n"
PRACH = "PRACH: cc=0, 1/1, preamble=12, offset=1.8 us, peak2avg=40.1, max_offset=100.0 us\n"
METRICS = (
    '{"timestamp":1718000000.0,"cells":[{"cell_metrics":{"pci":1},'
    '"ue_list":[{"ue":0,"pci":1,"rnti":17921,"ta_ns":520.8}]}]}\n'
)
GNB = (
    "[NR_MAC] [RAPROC] 341.19 Initiating RA procedure with preamble 12, energy 43.2 dB "
    "(I0 20, thres 120), delay 3 start symbol 0 freq index 0\n"
)
GNB_ANSWER = (
    "[NR_MAC] UE 4f1c: 342.7 Generating RA-Msg2 DCI, RA RNTI 0x10b, state 1, CoreSetType 0\n"
)
DISTANCE = "RAPID 12, timing_offset = 3 (estimated distance 234.4 [m])\n"
ENB = (
    "[PHY] [RAPROC] Frame 341, Initiating RA procedure with preamble 12, energy 43.2 dB, delay 3\n"
)


@pytest.mark.parametrize(
    ("numerology", "metres"), [(0, 78.07), (1, 39.04), (2, 19.52), (3, 9.76), (4, 4.88)]
)
def test_a_step_of_the_timing_advance_halves_with_each_numerology(
    numerology: int, metres: float
) -> None:
    assert step_m(numerology) == pytest.approx(metres, abs=5e-3)


def test_an_attach_in_srsran_4g_is_the_middle_of_its_step() -> None:
    (reading,) = SrsRan4gDecoder(SrsRan4gOptions(multipath_sigma_m=0.0)).feed(RACH.encode(), 0.0)

    assert reading.emitter == "0x46"
    assert reading.range_m == pytest.approx(273.2, abs=0.1)
    assert reading.range_sigma_m == pytest.approx(22.5, abs=0.05)


def test_detours_of_the_place_add_to_the_sigma_in_quadrature() -> None:
    (reading,) = SrsRan4gDecoder(SrsRan4gOptions(multipath_sigma_m=30.0)).feed(RACH.encode(), 0.0)

    assert reading.range_sigma_m == pytest.approx(math.hypot(22.536, 30.0), abs=0.01)


def test_the_finer_line_of_the_physical_layer_is_read_where_it_is_chosen() -> None:
    both = (RACH + PRACH).encode()
    (coarse,) = SrsRan4gDecoder().feed(both, 0.0)
    (fine,) = SrsRan4gDecoder(SrsRan4gOptions(log="phy")).feed(both, 0.0)

    assert coarse.emitter == "0x46"
    assert fine.emitter is None
    assert fine.range_m == pytest.approx(1.8 * 149.896, abs=0.01)


def test_what_is_left_of_the_timing_is_no_range_while_the_loop_is_on() -> None:
    decoder = SrsRanDecoder()

    assert decoder.feed(METRICS.encode(), 0.0) == []
    assert decoder.counts.refused == {"residual: the station corrects the timing (loop_is_off)": 1}


def test_with_the_loop_off_the_metrics_are_ranges() -> None:
    (reading,) = SrsRanDecoder(SrsRanOptions(loop_is_off=True, numerology=1)).feed(
        METRICS.encode(), 0.0
    )

    assert reading.emitter == "0x4601"
    assert reading.range_m == pytest.approx(78.07, abs=0.01)
    assert reading.device_time_s == 1718000000.0
    assert reading.range_sigma_m == pytest.approx(math.hypot(11.27, 20.0), abs=0.01)


def test_the_advance_that_the_phone_was_given_is_added() -> None:
    options = SrsRanOptions(loop_is_off=True, applied_steps=3, numerology=1)
    (reading,) = SrsRanDecoder(options).feed(METRICS.encode(), 0.0)

    assert reading.range_m == pytest.approx(78.07 + 3 * 39.04, abs=0.02)


def test_exactly_zero_is_no_observation() -> None:
    decoder = SrsRanDecoder(SrsRanOptions(loop_is_off=True))

    assert decoder.feed(METRICS.replace("520.8", "0.0").encode(), 0.0) == []
    assert decoder.counts.refused == {"not observed": 1}


def test_the_scheduler_s_line_of_an_attach_is_absolute() -> None:
    line = (
        "2024-06-10T06:13:20 [SCHED] [D] - RACH ind: slot_rx=341.19 pci=1 PRACHs: "
        "0: preamble=12 tc-rnti=0x4601 freq_idx=0 start_symbol=0 TA=5.2083e-07s "
        "1: preamble=3 tc-rnti=0x4602 freq_idx=0 start_symbol=0 TA=0.0s\n"
    )
    first, second = SrsRanDecoder().feed(line.encode(), 0.0)

    assert (first.emitter, second.emitter) == ("0x4601", "0x4602")
    assert first.range_m == pytest.approx(78.07, abs=0.01)
    assert second.range_m == 0.0


@pytest.mark.parametrize(
    "line",
    [
        METRICS[:-5],
        '{"cells":[]} x',
        '["cells", "cells"]',
        '{"timestamp":"x","cells":{"ue_list":1}}',
        '{"cells":[1,{"ue_list":[2,{"ta_ns":"1"},{"ta_ns":true},{"ta_ns":1e400,"rnti":1}]}]}',
        '{"cells":[{"ue_list":[{"ta_ns":99999999,"rnti":1}]}]}',
        '{"cells":[{"ue_list":[{"ta_ns":5.0,"rnti":' + "9" * 400 + "}]}]}",
        '{"cells":' + "[" * 50_000,
    ],
)
def test_documents_that_are_none_are_counted_and_give_nothing(line: str) -> None:
    decoder = SrsRanDecoder(SrsRanOptions(loop_is_off=True))

    assert decoder.feed(line.encode() + b"\n", 0.0) == []


@pytest.mark.parametrize(
    ("line", "numerology", "range_m"),
    [
        (GNB + GNB_ANSWER, 1, 3.5 * 39.04),
        (GNB + GNB_ANSWER, 0, 3.5 * 78.07),
        (GNB + GNB, 1, 3.5 * 39.04),
        (ENB, 1, 273.2),
    ],
)
def test_openairinterface_tells_steps_of_its_numerology(
    line: str, numerology: int, range_m: float
) -> None:
    (reading,) = OaiDecoder(NrOptions(numerology=numerology)).feed(line.encode(), 0.0)

    assert reading.range_m == pytest.approx(range_m, abs=0.1)
    assert reading.emitter is None


def test_a_numerology_that_the_log_contradicts_gives_no_reading_before_it_does() -> None:
    decoder = OaiDecoder(NrOptions(numerology=1))

    assert decoder.feed((GNB + GNB_ANSWER.rstrip() + f", {DISTANCE}").encode(), 0.0) == []
    assert decoder.counts.refused == {
        "first attach waits for its answer": 1,
        "the log is of numerology 0: set it": 1,
    }


def test_an_advance_beyond_the_standard_s_largest_is_refused() -> None:
    decoder = OaiDecoder(NrOptions(numerology=1))

    assert decoder.feed(GNB.replace("delay 3 ", "delay 65535 ").encode(), 0.0) == []
    assert decoder.counts.refused == {"timing advance is out of bounds": 1}


def test_the_phone_has_another_number_after_each_attach_and_need_not_be_named() -> None:
    (reading,) = SrsRan4gDecoder(SrsRan4gOptions(name="none")).feed(RACH.encode(), 0.0)

    assert reading.emitter is None


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (NrOptions, {"numerology": 5}),
        (CellOptions, {"multipath_sigma_m": -1.0}),
        (SrsRanOptions, {"applied_steps": 9999}),
        (SrsRanOptions, {"loop": True}),
        (SrsRan4gOptions, {"log": "rrc"}),
    ],
)
def test_absurd_options_are_refused(kind: type[CellOptions], options: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(options, kind)
