"""Our class against the one that pymavlink generates for ArduPilot's dialect."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from companion.mav.dialect import MAVLink_ekf_status_report_message, mavlink

THEIRS = ardupilotmega.MAVLink_ekf_status_report_message
VALUES = (0x333F, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


@pytest.mark.parametrize(
    "attribute",
    [
        *("id", "msgname", "fieldnames", "ordered_fieldnames", "fieldtypes", "native_format"),
        *("orders", "lengths", "array_lengths", "crc_extra", "instance_offset"),
    ],
)
def test_every_attribute_is_the_generated_one(attribute: str) -> None:
    assert getattr(MAVLink_ekf_status_report_message, attribute) == getattr(THEIRS, attribute)


def test_both_pack_the_same_bytes() -> None:
    ours = MAVLink_ekf_status_report_message(*VALUES).pack(mavlink.MAVLink(None, 1, 1))
    assert ours == THEIRS(*VALUES).pack(ardupilotmega.MAVLink(None, 1, 1))
    read = mavlink.MAVLink(None).decode(bytearray(ours))
    assert isinstance(read, MAVLink_ekf_status_report_message)
    assert read.flags == 0x333F
    assert read.airspeed_variance == pytest.approx(0.6)
