"""COMMAND_CANCEL (80) of MAVLink common, which the dialects of pymavlink 2.4.50 do not have.

It follows the protocol of the generated classes; see `radio_ranging`. Source: MAVLink common.
"""

from __future__ import annotations

import struct

from pymavlink.dialects.v20 import development as mavlink


class MAVLink_command_cancel_message(mavlink.MAVLink_message):
    """Ends a long-running command; its ACK, with CANCELLED, is the original command's."""

    id = 80
    msgname = "COMMAND_CANCEL"
    fieldnames = ["target_system", "target_component", "command"]
    ordered_fieldnames = ["command", "target_system", "target_component"]
    fieldtypes = ["uint8_t", "uint8_t", "uint16_t"]
    fielddisplays_by_name: dict[str, str] = {}
    fieldenums_by_name = {"command": "MAV_CMD"}
    fieldunits_by_name: dict[str, str] = {}
    native_format = bytearray(b"<HBB")
    orders = [1, 2, 0]
    lengths = [1, 1, 1]
    array_lengths = [0, 0, 0]
    crc_extra = 14
    unpacker = struct.Struct("<HBB")
    instance_field = None
    instance_offset = -1

    def __init__(self, target_system: int, target_component: int, command: int) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        self.target_system = target_system
        self.target_component = target_component
        self.command = command

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The frame's bytes, with `mav`'s ids and sequence number (which it does not advance)."""
        payload = self.unpacker.pack(self.command, self.target_system, self.target_component)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))
