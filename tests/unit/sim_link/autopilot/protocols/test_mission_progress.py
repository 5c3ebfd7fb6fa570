from __future__ import annotations

import pytest

from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink
from companion.mav.payloads import IdentifiedMissionCurrent
from sim_link.autopilot.protocols.plan_items import MissionProgress, MissionState
from tests.unit.sim_link.autopilot.protocols.wire import said

ACTIVE = MissionProgress(2, 5, MissionState.ACTIVE, is_in_mission_mode=True)


def current(progress: MissionProgress) -> mavlink.MAVLink_mission_current_message:
    message = said(IdentifiedMissionCurrent(*progress.fields))
    assert isinstance(message, mavlink.MAVLink_mission_current_message)
    return message


def test_the_item_the_total_and_the_state_are_reported() -> None:
    message = current(ACTIVE)
    assert (message.seq, message.total, message.mission_state) == (2, 5, 3)
    assert message.mission_mode == 1


@pytest.mark.parametrize(("count", "has_home", "total"), [(5, True, 4), (0, False, 65535)])
def test_home_does_not_count_and_no_mission_is_65535(
    count: int, has_home: bool, total: int
) -> None:
    progress = MissionProgress(0, count, MissionState.NO_MISSION, False, has_home)
    assert current(progress).total == total


def test_the_opaque_plan_ids_are_zero() -> None:
    """Extensions that are left out read as zero: the payload ends before them."""
    assert MavCodec(1, 1).encode(current(ACTIVE))[1] <= 6
