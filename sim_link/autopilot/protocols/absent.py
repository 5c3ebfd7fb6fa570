"""Services that the vehicle does not have, refused at once instead of by a silence.

Source: MAVLink developer guide, "File Transfer Protocol (FTP)"; MAVLink common, LOG_REQUEST_LIST.
"""

from __future__ import annotations

from companion.mav.dialect import Message, mavlink
from sim_link.autopilot.protocols.base import Outgoing, Partner

FTP_HEADER_LENGTH, FTP_PAYLOAD_LENGTH = 12, 251
ACK, NAK = 128, 129
ENDS_SESSIONS = (0, 1, 2)
"""None, TerminateSession and ResetSessions, which have nothing to do and succeed."""
FILE_NOT_FOUND = 10


def refusal(message: Message, partner: Partner) -> list[Outgoing]:
    """What is answered to a request of files or logs that is for us; any other gets no answer."""
    match message:
        case mavlink.MAVLink_file_transfer_protocol_message():
            answer = _no_such_file(bytes(message.payload), partner)
        case mavlink.MAVLink_log_request_list_message():
            answer = mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0)
        case _:
            return []
    return [] if answer is None else [Outgoing(answer, partner.channel)]


def _no_such_file(request: bytes, partner: Partner) -> Message | None:
    """The NAK of an FTP request; None for what is a reply itself."""
    opcode = request[3]
    if opcode >= ACK:
        return None
    sequence = (int.from_bytes(request[:2], "little") + 1) & 0xFFFF
    is_done = opcode in ENDS_SESSIONS
    error = b"" if is_done else bytes((FILE_NOT_FOUND,))
    head = sequence.to_bytes(2, "little")
    head += bytes((request[2], ACK if is_done else NAK, len(error), opcode))
    payload = (head.ljust(FTP_HEADER_LENGTH, b"\0") + error).ljust(FTP_PAYLOAD_LENGTH, b"\0")
    return mavlink.MAVLink_file_transfer_protocol_message(
        0, partner.system_id, partner.component_id, list(payload)
    )
