"""`companion radio calibrate --beside`: one command, and the offset is there in flight."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.cli import main
from companion.config.radios import is_uncalibrated
from companion.config.schema import load_config, with_radios
from companion.flight_setup import with_kept_offsets
from companion.io.checkpoints import radio_key

LINE = "RACH:  tti=9241, preamble=31, offset=13, temp_crnti=0x4a\n"
BY_LINES = "lines:pattern='d=(?P<range_m>[0-9.]+)'@exec:cat {}"


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def calibrate(radio: str, *options: str) -> int:
    words = ["radio", "calibrate", "--beside", "1", "--seconds", "1", "--radio", radio]
    return main([*words, *options])


def test_the_offset_of_a_cell_is_found_and_used_from_then_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "enb.log"
    log.write_text(LINE * 6)
    radio = f"srsran_4g:name=none@exec:cat {log}"
    (before,) = with_radios(load_config(None), [radio]).radios

    assert is_uncalibrated(before)
    assert calibrate(radio) == 0
    assert "range offset +1052.96 m" in capsys.readouterr().out

    config = with_kept_offsets(with_radios(load_config(None), [radio]))
    assert config.radios[0].settings["range_offset_m"] == pytest.approx(1052.96, abs=0.01)
    assert config.tracking.is_range_calibrated


def test_a_setting_goes_before_what_is_kept_and_other_radios_have_their_own(tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.write_text("d=3.5\n" * 6)
    radio = BY_LINES.format(text)
    assert calibrate(radio) == 0

    for given, expected in ((radio, 2.5), (radio.replace("'@", "',range_offset_m=1@"), 1)):
        (found,) = with_kept_offsets(with_radios(load_config(None), [given])).radios
        assert found.settings["range_offset_m"] == expected
    (other,) = with_kept_offsets(with_radios(load_config(None), [radio + "2"])).radios
    assert "range_offset_m" not in other.settings


def test_too_few_ranges_are_refused_with_what_was_seen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "text"
    text.write_text("hello\n")

    assert calibrate(BY_LINES.format(text)) == 1
    assert "not recognised; first: hello" in capsys.readouterr().err


def test_of_several_emitters_one_must_be_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "text"
    text.write_text("tag 1 d=3.5\ntag 2 d=9.5\n" * 6)
    radio = f"lines:pattern='tag (?P<emitter>.) d=(?P<range_m>[0-9.]+)'@exec:cat {text}"

    assert calibrate(radio) == 1
    assert "ranges of emitters 1, 2: which is beside the antenna?" in capsys.readouterr().err
    assert calibrate(radio, "--emitter", "2") == 0
    assert "range offset +8.50 m" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("printed", "words"),
    [("b=12\n" * 6, "measurements of lines without a range"), ("", "nothing heard")],
)
def test_a_radio_without_ranges_has_no_offset(
    printed: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "text"
    text.write_text(printed)

    assert calibrate(f"lines:pattern='b=(?P<azimuth_deg>[0-9]+)'@exec:cat {text}") == 1
    assert words in capsys.readouterr().err


def test_a_usb_radio_is_known_by_its_serial_number(tmp_path: Path) -> None:
    device = tmp_path / "ttyUSB0"
    device.touch()
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "usb-Maker_0042").symlink_to(device)

    for url in (str(device), f"serial:{device}:115200"):
        assert radio_key("pans", url, tmp_path / "by-id") == "pans usb-Maker_0042"


def test_an_offset_that_cannot_be_kept_is_shown_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/proc")  # it takes no folders
    log = tmp_path / "enb.log"
    log.write_text(LINE * 6)
    assert calibrate(f"srsran_4g:name=none@exec:cat {log}") == 1
    said = capsys.readouterr().err
    assert "not kept, so configure it: /proc/companion: cannot be created" in said
    assert "range_offset_m: 1052.958" in said


def test_what_is_kept_and_cannot_be_read_is_named(tmp_path: Path) -> None:
    file = tmp_path / "state" / "companion" / "radio-offsets.json"
    file.parent.mkdir(parents=True)
    file.write_text(json.dumps({"x": 1}))

    assert calibrate(BY_LINES.format(tmp_path)) in (1, 2)
    assert main(["radio", "watch", "pans@/dev/ttyUSB0", "--seconds", "0.1"]) == 2
