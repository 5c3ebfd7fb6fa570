from __future__ import annotations

from pymavlink.generator.mavcrc import x25crc

from companion.mav.codec import MavCodec
from companion.mav.dialect import MAVLink_command_cancel_message


def test_the_crc_extra_is_that_of_its_definition() -> None:
    """MAVLink developer guide, "Serialization": name, then type and name of each ordered field."""
    kind = MAVLink_command_cancel_message
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    text = kind.msgname + " " + "".join(f"{types[n]} {n} " for n in kind.ordered_fieldnames)
    crc = x25crc(text.encode()).crc  # type: ignore[no-untyped-call]
    assert (crc & 0xFF) ^ (crc >> 8) == kind.crc_extra


def test_it_survives_the_wire() -> None:
    frame = MavCodec(255, 190).encode(MAVLink_command_cancel_message(1, 2, 0x1234))
    (message,) = MavCodec(1, 1).decode(frame)
    assert isinstance(message, MAVLink_command_cancel_message)
    assert (message.target_system, message.target_component) == (1, 2)
    assert message.command == 0x1234
    assert frame[10:12] == b"\x34\x12"
