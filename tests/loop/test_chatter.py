"""Inputs that come and go twice a second make a few texts a minute, on the log and on the air."""

from __future__ import annotations

import re
from collections import Counter
from functools import partial

import pytest

from companion.config.schema import CompanionConfig
from companion.guidance.phases import IN_CONTROL
from companion.link.text_gate import CAUSE_PERIOD_S
from companion.mav.dialect import mavlink
from sim_link.autopilot.scenario import AutopilotParams, FlavourName, Scenario
from sim_link.lab.faults.fault_models import Fault, Schedule, StreamMute
from sim_link.lab.observer import Frame, Observer
from tests.loop.loop_helpers import AUTO, Loop

SLOW = partial(pytest.param, marks=pytest.mark.slow)
LASTS_S = 80.0
FLAVOURS: tuple[FlavourName, ...] = ("px4", "ardupilot")
AT_2_HZ, AT_0_4_HZ = 0.25, 1.25
"""Half a period, seconds: shorter than every timeout of an input, and longer than most."""
POSITION, HOME = ("LOCAL_POSITION_NED",), ("HOME_POSITION",)
ALL = (*POSITION, "ATTITUDE", "EXTENDED_SYS_STATE", "SYS_STATUS", "GPS_RAW_INT")


def flapping(streams: tuple[str, ...], half_s: float, begins_s: float) -> list[Fault]:
    """Each stream is mute for half of the time."""
    return [
        StreamMute(message=stream, start_s=begins_s + 2 * n * half_s, duration_s=half_s)
        for stream in streams
        for n in range(round(LASTS_S / (2 * half_s)))
    ]


class Downlink(Observer):
    """Bytes and texts that leave towards the ground, by time."""

    def __init__(self) -> None:
        self.texts: list[tuple[float, int]] = []

    def sent(self, frame: Frame) -> None:
        if isinstance(frame.message, mavlink.MAVLink_statustext_message):
            self.texts.append((frame.time_s, len(frame.data)))

    def most_in_a_minute(self) -> int:
        return max(
            (sum(size for t, size in self.texts if at - 60.0 < t <= at) for at, _ in self.texts),
            default=0,
        )


def crowded(texts: list[tuple[float, str]]) -> dict[str, int]:
    """Texts that are the same but for figures, more than twice within a period."""
    by_cause: dict[str, list[float]] = {}
    for time_s, text in texts:
        by_cause.setdefault(re.sub(r"[\d.]+", "#", text), []).append(time_s)
    return {
        cause: most
        for cause, times_s in by_cause.items()
        if (most := max(Counter(t // CAUSE_PERIOD_S for t in times_s).values())) > 2
    }


FLAPPING = [
    (POSITION, AT_0_4_HZ, HOME, False),
    (POSITION, AT_0_4_HZ, (), False),
    (POSITION, AT_0_4_HZ, (), True),
    (("RADIO_RANGING",), 3.0, (), True),
    (("GPS_RAW_INT",), AT_0_4_HZ, (), True),
]


@pytest.mark.parametrize(
    ("flavour", "streams", "half_s", "missing", "flies"),
    [
        *((flavour, POSITION, AT_2_HZ, HOME, False) for flavour in FLAVOURS),
        ("ardupilot", ALL, AT_0_4_HZ, (), True),
        SLOW("px4", ALL, AT_0_4_HZ, (), True),
        *(SLOW(flavour, *each) for flavour in FLAVOURS for each in FLAPPING),
    ],
)
def test_what_flaps_makes_few_texts(
    flavour: FlavourName,
    streams: tuple[str, ...],
    half_s: float,
    missing: tuple[str, ...],
    flies: bool,
) -> None:
    begins_s = 0.0 if missing else 20.0
    faults = flapping(streams, half_s, begins_s)
    faults += [StreamMute(message=message, duration_s=LASTS_S) for message in missing]
    scenario = Scenario(autopilot=AutopilotParams(flavour=flavour))
    loop = Loop(AUTO if flies else CompanionConfig(), scenario, 3, Schedule(faults=tuple(faults)))
    downlink = Downlink()
    loop.flight.observers.append(downlink)
    if flies:
        loop.run_until(lambda: loop.phase in IN_CONTROL, begins_s + 5.0)
    loop.run(LASTS_S - loop.now_s)
    assert crowded([note for note in loop.notes.texts if note[0] >= begins_s]) == {}
    assert downlink.most_in_a_minute() <= 1000 + (1000 if flies else 0)
