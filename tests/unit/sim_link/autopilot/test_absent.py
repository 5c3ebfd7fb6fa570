from __future__ import annotations

import pytest

from companion.mav.dialect import mavlink
from sim_link.autopilot.services import reject_unsupported_service
from tests.unit.sim_link.autopilot.protocols.wire import STATION, of_type, received

Ftp = mavlink.MAVLink_file_transfer_protocol_message
TERMINATE_SESSION, RESET_SESSIONS, LIST_DIRECTORY, OPEN_FILE, BURST_READ = 1, 2, 3, 4, 15


def request(opcode: int, sequence: int = 7) -> Ftp:
    payload = sequence.to_bytes(2, "little") + bytes((3, opcode, 4, 0, 0, 0)) + bytes(4) + b"/a.b"
    return Ftp(0, 1, 1, list(payload.ljust(251, b"\0")))


def answer_to(message: Ftp) -> bytes:
    (answer,) = of_type(reject_unsupported_service(received(message), STATION), Ftp)
    assert (answer.target_system, answer.target_component) == (255, 190)
    return bytes(answer.payload)


@pytest.mark.parametrize("opcode", [LIST_DIRECTORY, OPEN_FILE, BURST_READ, 99])
def test_there_is_no_file(opcode: int) -> None:
    answer = answer_to(request(opcode))
    assert answer[:2] == (8).to_bytes(2, "little")
    assert list(answer[2:6]) == [3, 129, 1, opcode]
    assert answer[12] == 10


@pytest.mark.parametrize("opcode", [TERMINATE_SESSION, RESET_SESSIONS])
def test_sessions_may_always_be_ended(opcode: int) -> None:
    assert list(answer_to(request(opcode))[3:6]) == [128, 0, opcode]


def test_the_sequence_number_begins_again_after_its_last() -> None:
    assert answer_to(request(OPEN_FILE, 0xFFFF))[:2] == b"\0\0"


@pytest.mark.parametrize("opcode", [128, 129])
def test_replies_are_never_answered(opcode: int) -> None:
    assert reject_unsupported_service(received(request(opcode)), STATION) == []


def test_the_list_of_logs_is_empty() -> None:
    asked = received(mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF))
    (entry,) = of_type(
        reject_unsupported_service(asked, STATION), mavlink.MAVLink_log_entry_message
    )
    assert (entry.num_logs, entry.size) == (0, 0)


def test_anything_else_is_not_its_business() -> None:
    assert (
        reject_unsupported_service(
            received(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), STATION
        )
        == []
    )
