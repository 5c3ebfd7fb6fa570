from __future__ import annotations

import pytest

from companion.guidance.phases import (
    IN_CONTROL,
    OUT_OF_CONTROL,
    STREAMING,
    TRANSITIONS,
    Phase,
    Trigger,
    next_phase,
)

TABLE = """
          READY   FENCE_LOST ID_CONFLICT LAUNCH    LAUNCH_FAILED MODE_GIVEN MODE_LOST GRANTED DISARMED LANDED INPUT_AGES INPUT_LOST INPUT_BACK LOCALISED HAND_BACK CONTENTION RESTARTED STOP     HANDED_BACK YIELD_RECALLED REPORT_RECALLED PILOT_TOOK MODE_LEFT NOT_OURS
WAITING   STANDBY .          .          .         .             .          .         .       .        .      .          .          .          .         .        .        .         STOPPED  .           YIELD          FINISHED               .          .         .
STANDBY   .       WAITING    WAITING    LAUNCHING .             HOLD       .         .       .        .      .          .          .          .         .        .        WAITING   STOPPED  .           YIELD          FINISHED               .          .         WAITING
LAUNCHING .       .          .          .         YIELD         HOLD       YIELD     .       WAITING  .      .          .          .          .         .        .        WAITING   HANDBACK .           .              .               .          .         YIELD
NORMAL    .       .          .          .         .             .          YIELD     .       WAITING  YIELD  DEGRADED   HOLD       .          FINISHED  HANDBACK YIELD    WAITING   HANDBACK .           .              .               YIELD      .         YIELD
DEGRADED  .       .          .          .         .             .          YIELD     .       WAITING  YIELD  .          HOLD       NORMAL     FINISHED  HANDBACK YIELD    WAITING   HANDBACK .           .              .               YIELD      .         YIELD
HOLD      .       .          .          .         .             .          YIELD     .       WAITING  YIELD  DEGRADED   .          NORMAL     FINISHED  HANDBACK YIELD    WAITING   HANDBACK .           .              .               YIELD      .         YIELD
FINISHED  .       .          .          .         .             .          .         STANDBY WAITING  YIELD  .          .          .          .         .        .        WAITING   HANDBACK .           .              .               .          .         YIELD
YIELD     .       .          .          .         .             .          .         STANDBY WAITING  .      .          .          .          .         .        .        WAITING   STOPPED  .           .              .               .          WAITING         .
HANDBACK  .       .          .          .         .             .          YIELD     .       WAITING  YIELD  .          .          .          .         .        .        WAITING   .        YIELD       .              .               .          .         YIELD
STOPPED   .       .          .          .         .             .          .         .       .        .      .          .          .          .         .        .        .         .        .           .              .               .          .         .
"""  # noqa: E501  one row per phase is the point
_HEAD, *_ROWS = [line.split() for line in TABLE.strip().splitlines()]
EXPECTED = {
    (Phase[row[0]], Trigger[name]): Phase[row[0]] if cell == "." else Phase[cell]
    for row in _ROWS
    for name, cell in zip(_HEAD, row[1:], strict=True)
}


def test_the_table_of_this_test_is_complete() -> None:
    assert set(EXPECTED) == {(phase, trigger) for phase in Phase for trigger in Trigger}


@pytest.mark.parametrize("phase", Phase)
def test_every_trigger_in_every_phase(phase: Phase) -> None:
    for trigger in Trigger:
        assert next_phase(phase, trigger) is EXPECTED[phase, trigger], trigger


def test_every_phase_can_be_reached() -> None:
    reached, frontier = {Phase.WAITING}, [Phase.WAITING]
    while frontier:
        here = frontier.pop()
        for (phase, _), following in TRANSITIONS.items():
            if phase is here and following not in reached:
                reached.add(following)
                frontier.append(following)
    assert reached == set(Phase)


def test_nothing_leaves_stopped() -> None:
    assert all(next_phase(Phase.STOPPED, trigger) is Phase.STOPPED for trigger in Trigger)


def test_control_is_only_entered_by_the_mode_being_given() -> None:
    entries = {
        trigger
        for (phase, trigger), following in TRANSITIONS.items()
        if following in IN_CONTROL and phase not in IN_CONTROL
    }
    assert entries == {Trigger.MODE_GIVEN}


def test_where_setpoints_may_flow() -> None:
    assert frozenset({Phase.NORMAL, Phase.DEGRADED, Phase.HOLD}) == IN_CONTROL
    assert set(Phase) - STREAMING == OUT_OF_CONTROL
    assert frozenset({Phase.WAITING, Phase.YIELD, Phase.STOPPED}) == OUT_OF_CONTROL
