"""Times in the logs of a flight are those of the wall clock, however long its start took."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from companion import run
from companion.config.schema import CompanionConfig, LogConfig, ProcessConfig
from companion.flight_setup import build_planner
from companion.io.files import EVENTS, FLIGHT, MCAP, TLOG
from companion.io.links.transports import FlightLink, UdpBind
from companion.io.log_files import read_tlog
from companion.io.shell import Clock
from companion.link.endpoint import CompanionEndpoint
from companion.link.interface import VEHICLE_ONLY, VehicleParams
from companion.mav.codec import MavCodec
from companion.mav.endpoint import Chunk
from tests.ports import free_port
from tests.unit.companion.link.wire import PEER, heartbeat

SLOW_START_S = 0.6
NEAR_S = 0.05


class Watching(run.FlightView):
    """Notes the wall clock when something is recorded, and ends the flight after a while."""

    def __init__(self) -> None:
        self.noted_unix_s: list[float] = []

    def record(self, kind: str, fields: Mapping[str, object], now_s: float) -> None:
        del kind, fields, now_s
        self.noted_unix_s.append(time.time())

    def least_delay_s(self, logged_unix_s: list[float]) -> float:
        """Return the shortest delay of records after the log's times; a busy computer adds."""
        assert len(logged_unix_s) >= 3
        pairs = zip(self.noted_unix_s, logged_unix_s, strict=False)
        return min(noted_s - logged_s for noted_s, logged_s in pairs)

    def update(self, endpoint: CompanionEndpoint, now_s: float) -> None:
        if not endpoint.binding.is_bound:
            self.heard_unix_s = time.time()
            endpoint.receive(Chunk(0, MavCodec(1, 1).encode(heartbeat()), PEER), now_s)
        elif now_s > 0.3:
            endpoint.request_stop(now_s)


def late_planner(*arguments: Any) -> Any:
    time.sleep(SLOW_START_S)
    return build_planner(*arguments)


def test_a_slow_start_does_not_shift_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = pytest.importorskip("mcap.reader")
    monkeypatch.setattr(run, "build_planner", late_planner)
    config = CompanionConfig(
        vehicle=VehicleParams(system_id=1),
        log=LogConfig(directory=str(tmp_path / "logs"), mcap=True),
        process=ProcessConfig(state_directory=str(tmp_path / "state"), resume_max_age_s=None),
    )
    clock, watching = Clock(), Watching()
    time.sleep(SLOW_START_S)
    link = FlightLink(UdpBind("127.0.0.1", free_port()), VEHICLE_ONLY[0])
    run.fly(config, [link], clock, run.FlightOptions(views=(watching,)))
    (directory,) = (tmp_path / "logs").iterdir()
    started_unix_s = json.loads((directory / FLIGHT).read_text())["started_unix_s"]
    lines = map(json.loads, (directory / EVENTS).read_text().splitlines())
    logged_s = [started_unix_s + line["t_s"] for line in lines if line["kind"] != "text"]
    assert watching.least_delay_s(logged_s) == pytest.approx(0.0, abs=NEAR_S)
    heard = next(read_tlog(directory / TLOG))
    assert heard.unix_us / 1e6 == pytest.approx(watching.heard_unix_s, abs=NEAR_S)
    with (directory / MCAP).open("rb") as file:
        messages = reader.make_reader(file).iter_messages(topics=["/events"])
        logged_s = [message.log_time / 1e9 for _, _, message in messages]
    assert watching.least_delay_s(logged_s) == pytest.approx(0.0, abs=NEAR_S)
