"""Checkpoints that are resumed, and files that are kept or deleted."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import pytest

from companion.config.schema import CompanionConfig, LimitsConfig, LogConfig
from companion.domain import LandedState
from companion.geometry.geofence import GeoArea, GeoFence
from companion.guidance.commands import SessionParams
from companion.guidance.emitters import QueueParams
from companion.guidance.events import AutopilotFenceRead, LandedStateChanged
from companion.io.checkpoints import Moment
from companion.link.endpoint import CompanionEndpoint
from companion.persistence import RestartKeeper
from tests.unit.companion.process.rig import WatchedNotes, an_endpoint, hear_autopilot
from tools.campaign.checkpointing import MemoryStore

CONFIG = CompanionConfig()
AUTO = msgspec.structs.replace(CONFIG, mission=SessionParams(engage="auto"))


@dataclass
class Clock:
    time_s: float = 0.0
    speed: float = 1.0

    def now_s(self) -> float:
        return self.time_s


@pytest.fixture(autouse=True)
def _binds_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bind an autopilot at once: the time of listening is tested elsewhere."""
    monkeypatch.setattr("companion.link.binding.LISTEN_S", 0.0)


class Process:
    """One process after another on the same store and the same kernel."""

    def __init__(self) -> None:
        self.store = MemoryStore()
        self.moment = Moment(1000.0, "kernel", 50.0)
        self.notes = WatchedNotes()
        self.endpoint: CompanionEndpoint | None = None

    def start(
        self, config: CompanionConfig = CONFIG, *, speed: float = 1.0, is_fresh: bool = False
    ) -> RestartKeeper:
        self.notes = WatchedNotes()
        self.clock = Clock(speed=speed)
        self.endpoint = an_endpoint(self.notes, config)
        return RestartKeeper(
            self.endpoint,
            self.store,
            config,
            self.clock,
            600.0,
            is_fresh=is_fresh,
            moment=lambda: self.moment,
        )

    def fly(self, keeper: RestartKeeper, **autopilot: int) -> None:
        """Three seconds with an autopilot."""
        assert self.endpoint is not None
        for tick in range(60):
            self.clock.time_s = 0.05 * tick
            if tick % 20 == 0:
                hear_autopilot(self.endpoint, self.clock.time_s, **autopilot)
            self.endpoint.handle_timer(self.clock.time_s)
            keeper.run(self.clock.time_s)

    def later(self, duration_s: float) -> None:
        self.moment = replace(
            self.moment,
            unix_s=self.moment.unix_s + duration_s,
            boot_s=self.moment.boot_s + duration_s,
        )

    def said(self, part: str) -> bool:
        return any(part in text for _, text in self.notes.texts)


@pytest.fixture
def process() -> Process:
    """A first process that was killed after three seconds, ten seconds ago."""
    process = Process()
    process.fly(process.start())
    process.later(10.0)
    return process


def test_nothing_is_kept_before_an_autopilot_is_heard() -> None:
    process = Process()
    keeper = process.start()
    keeper.run(5.0)
    assert not process.store.slots


def test_a_memory_is_kept_once_a_second(process: Process) -> None:
    checkpoint = process.store.load().checkpoint
    assert checkpoint is not None
    assert checkpoint.sequence == 2
    assert len(process.store.slots) == 2


def test_the_memory_of_the_same_mission_is_taken_up_when_the_vehicle_is_heard(
    process: Process,
) -> None:
    keeper = process.start()
    assert keeper.is_restart
    keeper.run(0.0)
    assert not process.said("resumed")
    process.fly(keeper)
    assert process.said("resumed after 10 s in waiting: reselect the mode to fly")


def test_the_sequence_goes_on_after_a_restart(process: Process) -> None:
    process.fly(process.start())
    checkpoint = process.store.load().checkpoint
    assert checkpoint is not None
    assert checkpoint.sequence == 5


@pytest.mark.parametrize(
    ("config", "autopilot", "reason"),
    [
        (CONFIG, {"system_id": 2}, "another vehicle (it was PX4, system 1)"),
        (CONFIG, {"autopilot": 3}, "another vehicle (it was PX4, system 1)"),
        (CompanionConfig(limits=LimitsConfig(speed_mps=4.0)), {}, "other limits or another fence"),
        (AUTO, {}, "another mission or estimator"),
        (CompanionConfig(emitters=QueueParams(listed=(7,))), {}, "another mission or estimator"),
    ],
)
def test_a_memory_of_something_else_is_reported_and_not_taken_up(
    process: Process, config: CompanionConfig, autopilot: dict[str, int], reason: str
) -> None:
    keeper = process.start(config)
    process.fly(keeper, **autopilot)
    assert process.said(f"restarted with {reason}: starting a new mission, no automatic engagement")
    assert not process.said("resumed")
    assert process.endpoint is not None
    assert process.endpoint.session.context.has_launched


def test_where_logs_go_is_no_other_mission(process: Process) -> None:
    keeper = process.start(CompanionConfig(log=LogConfig(directory="elsewhere")))
    process.fly(keeper)
    assert process.said("resumed")


def test_a_memory_that_is_too_old_is_as_none(
    process: Process, caplog: pytest.LogCaptureFixture
) -> None:
    process.later(600.0)
    with caplog.at_level(logging.INFO, "companion.run"):
        keeper = process.start(AUTO)
    assert "610 s old, beyond process.resume_max_age_s: starting a new mission" in caplog.text
    assert not keeper.is_restart
    assert process.endpoint is not None
    assert not process.endpoint.session.context.has_launched


@pytest.mark.parametrize(
    "moment", [Moment(900.0, "another kernel", 3.0), Moment(1010.0, "kernel", 3.0)]
)
def test_a_memory_of_unknown_age_is_not_taken_up_and_nothing_engages(
    process: Process, moment: Moment, caplog: pytest.LogCaptureFixture
) -> None:
    process.moment = moment
    keeper = process.start(AUTO)
    assert keeper.is_restart
    assert "its age is unknown: starting a new mission, no automatic engagement" in caplog.text
    process.fly(keeper)
    assert not process.said("resumed")
    assert process.endpoint is not None
    assert process.endpoint.session.context.has_launched


def test_after_a_restart_of_the_computer_the_wall_clock_tells_the_age(process: Process) -> None:
    process.moment = Moment(1040.0, "another kernel", 3.0)
    process.fly(process.start())
    assert process.said("resumed after 40 s")


def test_damaged_files_mean_a_cold_start_that_engages_nothing(
    process: Process, caplog: pytest.LogCaptureFixture
) -> None:
    process.store.slots = {number: data[:-1] for number, data in process.store.slots.items()}
    keeper = process.start(AUTO)
    assert keeper.is_restart
    assert "none is whole: starting a new mission, no automatic engagement" in caplog.text
    assert process.endpoint is not None
    assert process.endpoint.session.context.has_launched
    process.fly(keeper)
    assert process.store.load().checkpoint is not None


def test_an_operator_may_say_that_there_is_nothing_to_take_up(process: Process) -> None:
    keeper = process.start(AUTO, is_fresh=True)
    assert not keeper.is_restart
    assert not process.store.slots
    assert process.endpoint is not None
    assert not process.endpoint.session.context.has_launched


def test_in_a_fast_simulation_the_age_is_in_its_seconds(process: Process) -> None:
    process.fly(process.start(speed=8.0))
    assert process.said("resumed after 80 s")


def test_a_process_that_was_killed_leaves_its_memory(process: Process) -> None:
    keeper = process.start()
    process.fly(keeper)
    keeper.close(0.0)
    assert process.store.slots


def test_a_process_that_ends_in_order_with_an_armed_vehicle_leaves_its_memory(
    process: Process,
) -> None:
    keeper = process.start()
    process.fly(keeper)
    before = process.store.load().checkpoint
    assert process.endpoint is not None
    process.endpoint.request_stop(3.0)
    assert process.endpoint.is_finished
    keeper.close(0.0)
    after = process.store.load().checkpoint
    assert before is not None
    assert after is not None
    assert after.sequence == before.sequence + 1


def test_a_process_that_ends_before_it_heard_the_vehicle_leaves_what_it_found(
    process: Process,
) -> None:
    keeper = process.start()
    assert process.endpoint is not None
    process.endpoint.request_stop(0.0)
    keeper.close(0.0)
    assert process.store.slots


# A fence that is not in the configuration itself

FIELD = ((47.39, 8.54), (47.39, 8.56), (47.41, 8.56), (47.41, 8.54))
WIDER = ((47.39, 8.53), *FIELD[1:])


def of_file(folder: Path, corners: tuple[tuple[float, float], ...]) -> CompanionConfig:
    """A configuration with a fence in a file, always of the same name."""
    polygon = {"inclusion": True, "polygon": corners, "version": 1}
    fence = {"circles": [], "polygons": [polygon], "version": 2}
    path = folder / "site.plan"
    path.write_text(json.dumps({"fileType": "Plan", "geoFence": fence, "version": 1}))
    return CompanionConfig(limits=LimitsConfig(fence_file=str(path)))


@pytest.mark.parametrize(("corners", "is_resumed"), [(FIELD, True), (WIDER, False)])
def test_a_memory_is_taken_up_only_with_the_same_fence_in_its_file(
    tmp_path: Path, corners: tuple[tuple[float, float], ...], is_resumed: bool
) -> None:
    process = Process()
    process.fly(process.start(of_file(tmp_path, FIELD)))
    process.fly(process.start(of_file(tmp_path, corners)))
    assert process.said("resumed after") is is_resumed
    assert process.said("other limits or another fence") is not is_resumed


@pytest.mark.parametrize(
    ("corners", "landed", "is_resumed"),
    [
        (FIELD, LandedState.ON_GROUND, True),
        (WIDER, LandedState.ON_GROUND, False),
        (WIDER, LandedState.IN_AIR, True),
        (WIDER, LandedState.UNKNOWN, True),
    ],
)
def test_a_memory_waits_for_the_autopilots_fence_which_may_be_another_one_in_the_air(
    corners: tuple[tuple[float, float], ...], landed: LandedState, is_resumed: bool
) -> None:
    config = CompanionConfig(limits=LimitsConfig(autopilot_fence="use"))
    process = Process()

    def read_fence(fence: tuple[tuple[float, float], ...]) -> None:
        assert process.endpoint is not None
        process.endpoint.session.handle(AutopilotFenceRead(0.0, GeoFence(GeoArea(fence))))

    keeper = process.start(config)
    read_fence(FIELD)
    process.fly(keeper)
    kept = dict(process.store.slots)
    keeper = process.start(config)
    process.fly(keeper)
    assert process.store.slots == kept
    assert not process.said("resumed after")
    assert process.endpoint is not None
    process.endpoint.session.handle(LandedStateChanged(0.0, landed))
    read_fence(corners)
    process.fly(keeper)
    assert process.said("resumed after") is is_resumed
    assert process.said("other limits or another fence") is not is_resumed
