"""Our hand-written classes against those that mavgen makes from our XML."""

from __future__ import annotations

import importlib.util
import math
import re
from pathlib import Path
from typing import Any

import pytest
from pymavlink.generator import mavgen

import companion.mav
from companion.mav.dialect import (
    MAVLink_radio_ranging_message,
    MAVLink_target_estimate_message,
    mavlink,
)

OURS = (MAVLink_radio_ranging_message, MAVLink_target_estimate_message)
XML = Path(companion.mav.__file__).with_name("radio_ranging.xml")


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The module generated from our XML alone: its include only adds other messages."""
    directory = tmp_path_factory.mktemp("mavgen")
    source = directory / "radio_ranging_alone.xml"
    source.write_text(re.sub(r"<include>.*</include>", "", XML.read_text(encoding="utf-8")))
    output = directory / "radio_ranging_alone.py"
    options = mavgen.Opts(str(output), "2.0", "Python3", validate=True)  # type: ignore[no-untyped-call]
    assert mavgen.mavgen(options, [str(source)])  # type: ignore[no-untyped-call]
    spec = importlib.util.spec_from_file_location(output.stem, output)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "attribute",
    [
        "id",
        "msgname",
        "fieldnames",
        "ordered_fieldnames",
        "fieldtypes",
        "fieldunits_by_name",
        "native_format",
        "orders",
        "lengths",
        "array_lengths",
        "crc_extra",
        "instance_field",
        "instance_offset",
    ],
)
@pytest.mark.parametrize("ours", OURS)
def test_every_attribute_is_the_generated_one(generated: Any, ours: Any, attribute: str) -> None:
    assert getattr(ours, attribute) == getattr(getattr(generated, ours.__name__), attribute)


@pytest.mark.parametrize("ours", OURS)
def test_the_payload_has_the_generated_layout(generated: Any, ours: Any) -> None:
    assert ours.unpacker.format == getattr(generated, ours.__name__).unpacker.format


ESTIMATES: list[tuple[Any, ...]] = [
    (1, 473_977_410, 85_455_930, *(0.5 * number for number in range(12)), 99, 7, 2, 7.5, 3.0, 6.0),
    (2**32 - 1, 2**31 - 1, -(2**31), *[math.nan] * 12, 2**32 - 1, 65535, 255, *[math.nan] * 3),
    (0, 0, 0, *[0.0] * 12, 0, 0, 0, 0.0, 0.0, 0.0),
]


@pytest.mark.parametrize("values", ESTIMATES)
def test_both_pack_the_same_estimate(generated: Any, values: tuple[Any, ...]) -> None:
    ours = MAVLink_target_estimate_message(*values).pack(mavlink.MAVLink(None, 3, 191))
    theirs = generated.MAVLink_target_estimate_message(*values)
    assert ours == theirs.pack(generated.MAVLink(None, 3, 191))
    assert str(generated.MAVLink(None).decode(bytearray(ours))) == str(
        mavlink.MAVLink(None).decode(bytearray(ours))
    )


VALUES: list[tuple[Any, ...]] = [
    (1, 80.5, 3.0, 0.5, 0.1, -0.2, 0.05, 7, 99, 5),
    (2**64 - 1, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, 65535, 255, 255),
    (0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0),
    (1_795_229_400_000_000, math.inf, -math.inf, -3.14, 1e-9, 1e30, 0.0, 1, 0, 0),
    (7, 80.0, math.nan, 0.0, 0.0, 0.0, 0.0, 0, 0, 0),
    (7, math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, 7, 255, 0, -71.0),
    (7, 80.0, 1.0, 0.5, 0.1, -0.2, 0.05, 7, 255, 0, math.nan),
]


@pytest.mark.parametrize("values", VALUES)
def test_both_pack_the_same_bytes(generated: Any, values: tuple[Any, ...]) -> None:
    ours = MAVLink_radio_ranging_message(*values).pack(mavlink.MAVLink(None, 3, 191))
    theirs = generated.MAVLink_radio_ranging_message(*values).pack(generated.MAVLink(None, 3, 191))
    assert ours == theirs


@pytest.mark.parametrize("values", VALUES)
def test_each_reads_what_the_other_packs(generated: Any, values: tuple[Any, ...]) -> None:
    ours = MAVLink_radio_ranging_message(*values).pack(mavlink.MAVLink(None, 3, 191))
    theirs = generated.MAVLink_radio_ranging_message(*values).pack(generated.MAVLink(None, 3, 191))
    read_by_them = generated.MAVLink(None).decode(bytearray(ours))
    read_by_us = mavlink.MAVLink(None).decode(bytearray(theirs))
    assert str(read_by_them) == str(read_by_us)
    assert read_by_us.get_type() == "RADIO_RANGING"


@pytest.mark.parametrize("ours", OURS)
def test_the_id_is_private_and_free_in_the_dialect(ours: Any) -> None:
    assert 45_000 <= ours.id <= 45_099
    others = [number for number, kind in mavlink.mavlink_map.items() if kind is not ours]
    assert ours.id not in others
