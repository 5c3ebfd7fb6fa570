"""The only import of pymavlink: the generated dialect, with our own message registered in it.

Everyone else takes message classes and enum values from here. `development` is the dialect that
holds RANGING_BEACON (513) beside all of `common`.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import development as mavlink

from companion.mav.radio_ranging import MAVLink_radio_ranging_message

Message = mavlink.MAVLink_message

mavlink.mavlink_map[MAVLink_radio_ranging_message.id] = MAVLink_radio_ranging_message

__all__ = ["MAVLink_radio_ranging_message", "Message", "mavlink"]
