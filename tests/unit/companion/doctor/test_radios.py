"""Results of the doctor about radios that it listened to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.config.radios import RadioConfig
from companion.doctor.findings import Level, RadioFacts
from companion.doctor.probe import check_radios, inspect_radios
from companion.link.quality import RadioStatus

STATUS = RadioStatus("nlink", 9.9, 0.05, 0.004, 50, {}, 0, 0)
GOOD = RadioFacts("nlink", "/dev/ttyUSB0", status=STATUS, bytes=3000, has_clock=True)


def said(facts: RadioFacts) -> dict[str, Level]:
    return {result.text: result.level for result in check_radios([facts])}


def test_a_good_radio_is_shown_with_rate_clock_and_calibration() -> None:
    assert said(GOOD) == {
        "9.9 Hz, 0 refused": Level.OK,
        "its own clock, received 4 ms late": Level.OK,
        "calibration is set": Level.OK,
    }


def test_a_radio_without_a_clock_is_no_fault() -> None:
    assert set(said(replace(GOOD, has_clock=False)).values()) == {Level.OK}


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        (replace(GOOD, uncalibrated=("ranges", "bearings")), "ranges and bearings are not calib"),
        (replace(GOOD, status=replace(STATUS, refused={"status RX": 20})), "status RX 20"),
        (replace(GOOD, status=replace(STATUS, silent_s=None, measured=0)), "nothing heard"),
        (replace(GOOD, status=replace(STATUS, measured=0)), "3000 bytes, nothing measured"),
        (replace(GOOD, status=replace(STATUS, restarts=2)), "restarted 2 times"),
        (replace(GOOD, status=replace(STATUS, age_s=0.9)), "900 ms late"),
    ],
)
def test_what_is_worse_than_it_could_be_is_a_warning(facts: RadioFacts, words: str) -> None:
    (text,) = [text for text, level in said(facts).items() if level is Level.WARN]
    assert words in text


def test_a_radio_that_cannot_be_opened_is_a_failure() -> None:
    (facts,) = inspect_radios([RadioConfig(name="ndjson", url="/dev/ttyNOWHERE")], 0.1)
    assert said(facts) == {
        "serial /dev/ttyNOWHERE: no such device; is it plugged in, and the name right?": Level.FAIL
    }


@pytest.mark.slow
def test_a_program_is_listened_to_for_a_while() -> None:
    line = '{\\"emitter_id\\":7,\\"range\\":42.5}'
    url = f'exec:while true; do echo "{line}"; sleep 0.05; done'
    (facts,) = inspect_radios([RadioConfig(name="ndjson", url=url)], 1.0)
    assert facts.status is not None
    assert facts.status.measured > 2
    assert not facts.has_clock
    assert facts.uncalibrated == ("ranges", "bearings")
