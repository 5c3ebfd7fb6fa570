"""The only import of pymavlink: the generated dialect, with more messages registered in it.

Ours are RADIO_RANGING and TARGET_ESTIMATE; EKF_STATUS_REPORT is ArduPilot's; COMMAND_CANCEL is
missing from pymavlink's.

Everyone else takes message classes and enum values from here. `development` is the dialect that
holds RANGING_BEACON (513) beside all of `common`.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import development as mavlink

from companion.mav.command_cancel import MAVLink_command_cancel_message
from companion.mav.ekf_status_report import MAVLink_ekf_status_report_message
from companion.mav.radio_ranging import MAVLink_radio_ranging_message
from companion.mav.target_estimate import MAVLink_target_estimate_message

Message = mavlink.MAVLink_message

mavlink.mavlink_map[MAVLink_radio_ranging_message.id] = MAVLink_radio_ranging_message
mavlink.mavlink_map[MAVLink_target_estimate_message.id] = MAVLink_target_estimate_message
mavlink.mavlink_map[MAVLink_ekf_status_report_message.id] = MAVLink_ekf_status_report_message
mavlink.mavlink_map[MAVLink_command_cancel_message.id] = MAVLink_command_cancel_message

__all__ = [
    "MAVLink_command_cancel_message",
    "MAVLink_ekf_status_report_message",
    "MAVLink_radio_ranging_message",
    "MAVLink_target_estimate_message",
    "Message",
    "mavlink",
]
