"""Output of `companion radio watch`, and recordings of `record` and their replay."""

from __future__ import annotations

import json
import math
import random
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from companion.arguments import argument_parser
from companion.cli import main
from companion.config.radios import RadioConfig, radio_setup
from companion.config.schema import CompanionConfig
from companion.errors import ConfigError
from companion.io.radio_recording import (
    RadioBytes,
    RadioRecordingWriter,
    RecordedOrigin,
    RecordedRadio,
    RecordingHeader,
    TimedPose,
    read_radio_recording,
)
from companion.link.intake import Authenticity
from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.endpoint import Chunk
from companion.radio_tools.radio_commands import WatchingEndpoint, scatter_of
from companion.radio_tools.recorder import PoseListener, RecordingEndpoint
from companion.radios import decoder
from companion.replay.replay_commands import replay_recording
from tests.unit.companion.link.wire import PEER, heartbeat, local_position, origin

EMITTER_ENU_M = (40.0, 30.0, 0.0)
SETUP = radio_setup(RadioConfig(name="ndjson"), "here")


def line(**fields: object) -> bytes:
    return json.dumps(fields).encode() + b"\n"


def watched(chunks: list[tuple[float, bytes]], end_s: float) -> list[list[str]]:
    shown: list[list[str]] = []
    endpoint = WatchingEndpoint([SETUP], ["ndjson@here"], shown.append, end_s)
    waiting = list(chunks)
    for tick in range(round(end_s / 0.05) + 1):
        now_s = 0.05 * tick
        while waiting and waiting[0][0] <= now_s:
            endpoint.receive(Chunk(0, waiting.pop(0)[1], is_datagram=False), now_s)
        endpoint.handle_timer(now_s)
    assert endpoint.is_finished
    return shown


def test_rate_range_bearing_and_scatter_are_shown_once_a_second() -> None:
    rng = random.Random(3)
    ranges_m = [42.0 + rng.gauss(0.0, 0.3) for _ in range(30)]
    said = [
        (0.1 * n, line(emitter_id=7, range=range_m, bearing=0.5, body_frame=True))
        for n, range_m in enumerate(ranges_m)
    ]
    shown = watched(said, 3.0)
    assert len(shown) == 3
    radio, emitter = shown[-1][-2:]
    assert radio.startswith("ndjson@here  9.7 Hz")
    assert "none refused" in radio
    assert "emitter 7" in emitter
    assert f"range    {ranges_m[-1]:.2f} m (scatter {scatter_of(ranges_m):.2f})" in emitter
    assert "bearing   +28.6 deg from the nose (scatter 0.00)" in emitter


def test_what_is_refused_is_shown_by_reason() -> None:
    shown = watched([(0.1, line(emitter_id=7, bearing=45) * 3)], 1.0)
    assert "refused: " in shown[-1][-1]
    assert shown[-1][-1].endswith(" 3")


def test_a_radio_that_says_nothing_is_shown_as_that() -> None:
    assert "nothing heard yet" in watched([], 1.0)[-1][-1]


def test_the_scatter_is_that_of_the_radio_and_not_of_the_way() -> None:
    rng = random.Random(5)
    walked = [0.5 * n + rng.gauss(0.0, 0.3) for n in range(2000)]
    assert scatter_of(walked) == pytest.approx(0.3, rel=0.1)
    assert scatter_of([1.0, 2.0]) is None
    turned = [math.remainder(math.pi + rng.gauss(0.0, 0.1), 2.0 * math.pi) for _ in range(2000)]
    assert scatter_of(turned, is_angle=True) == pytest.approx(0.1, rel=0.1)


def attitude(boot_ms: int, yaw_rad: float) -> Message:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.01, -0.02, yaw_rad, 0.0, 0.0, 0.0)


def test_a_pose_is_a_position_with_the_attitude_of_its_time() -> None:
    listener, autopilot = PoseListener(None, Authenticity()), MavCodec(1, 1)
    found: list[object] = []

    def say(message: Message, now_s: float) -> None:
        chunk = Chunk(0, autopilot.encode(message), PEER)
        found.extend(listener.receive(chunk, now_s))

    for second in range(4):  # a single autopilot is bound after three seconds
        say(heartbeat(), float(second))
    say(origin(), 3.01)
    say(attitude(4000, 0.2), 4.0)
    say(local_position(4050, 3.0, 4.0, -20.0, 0.0, 0.0, 0.0), 4.05)
    say(attitude(4100, 0.4), 4.1)
    position, pose = found
    assert isinstance(position, RecordedOrigin)
    assert position.latitude_deg == 47.0
    assert isinstance(pose, TimedPose)
    assert pose.t_s == pytest.approx(4.05, abs=0.01)
    assert pose.enu_m == (4.0, 3.0, 20.0)
    assert pose.yaw_rad == pytest.approx(0.3, abs=1e-3)
    assert pose.roll_rad == pytest.approx(0.01)
    assert pose.pitch_rad == pytest.approx(-0.02)


def test_the_autopilot_is_asked_for_streams_and_for_nothing_else() -> None:
    listener, autopilot, reader = PoseListener(1, Authenticity()), MavCodec(1, 1), MavCodec(9, 9)
    listener.receive(Chunk(0, autopilot.encode(heartbeat()), PEER), 0.0)
    asked = []
    for tick in range(100):
        for chunk in listener.due(0.05 * tick):
            asked += reader.decode(chunk.data)
    commands = {m.command for m in asked if isinstance(m, mavlink.MAVLink_command_long_message)}
    allowed = {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE}
    assert commands == allowed
    assert {m.get_type() for m in asked} == {"COMMAND_LONG", "HEARTBEAT", "TIMESYNC"}


def test_bytes_are_kept_as_they_come_and_where_the_line_was_lost(tmp_path: Path) -> None:
    path = tmp_path / "radio.jsonl"
    header = RecordingHeader(started_unix_s=0.0, radios=(RecordedRadio(name="ndjson", url="x"),))
    with RadioRecordingWriter(path, header) as writer:
        endpoint = RecordingEndpoint(writer, None, 2.0)
        for now_s, data in ((0.5, b'{"emit'), (0.6, b""), (1.0, b"\x00\xff")):
            endpoint.receive(Chunk(0, data, is_datagram=False), now_s)
        assert not endpoint.is_finished
        endpoint.handle_timer(2.0)
        assert endpoint.is_finished
    kept = [(r.t_s, r.data) for r in read_radio_recording(path)[1] if isinstance(r, RadioBytes)]
    assert kept == [(0.5, b'{"emit'), (0.6, b""), (1.0, b"\x00\xff")]


def recording(path: Path, *, with_poses: bool) -> Path:
    """A way past an emitter, whose ranges are 5 m too long."""
    header = RecordingHeader(started_unix_s=0.0, radios=(RecordedRadio(name="ndjson", url="x"),))
    with RadioRecordingWriter(path, header) as writer:
        for step in range(200):
            now_s = 0.25 * step
            position = (0.4 * step, 20.0 * math.sin(0.1 * step), 20.0)
            if with_poses:
                writer.write(TimedPose(now_s, position, 0.0))
            range_m = math.dist(position, EMITTER_ENU_M) + 5.0
            writer.write(RadioBytes(now_s, 0, line(emitter_id=7, range=range_m)))
    return path


def test_a_recording_is_decoded_again_with_other_settings(tmp_path: Path) -> None:
    path = recording(tmp_path / "radio.jsonl", with_poses=True)
    radio = RadioConfig(name="ndjson", settings={"range_offset_m": 5.0})
    replay = replay_recording(path, CompanionConfig(radios=(radio,)))
    (target,) = replay.targets
    assert (target.target_id, target.rows) == ("7", 200)
    assert target.estimate is not None
    assert math.dist(target.estimate.position_enu_m, EMITTER_ENU_M[:2]) < 1.0
    assert replay.radios[0].startswith("radio ndjson: ")


def test_without_places_it_is_reported_what_was_said(tmp_path: Path) -> None:
    path = recording(tmp_path / "radio.jsonl", with_poses=False)
    replay = replay_recording(path, CompanionConfig())
    assert replay.targets == []
    assert "emitter 7: 200 measurements, median range" in replay.radios[1]
    assert replay.radios[-1].startswith("no estimate")


@pytest.mark.parametrize("words", [["watch"], ["record", "f.jsonl"]])
def test_without_a_radio_a_command_says_how_to_name_one(words: list[str]) -> None:
    from companion.radio_tools.radio_commands import run

    arguments = argument_parser().parse_args(["radio", *words])
    with pytest.raises(ConfigError, match="name a radio, for example nlink@"):
        run(arguments)


@pytest.fixture
def broken_plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("sonar", "a_module_that_is_not_there:SONAR", decoder.GROUP)
    monkeypatch.setattr(decoder, "entry_points", lambda **_: [point])


@pytest.mark.usefixtures("broken_plugin")
def test_a_broken_plugin_that_is_chosen_is_named_and_ends_with_2(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["--connect", "udp:127.0.0.1:14999", "--radio", "sonar@/dev/null"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("companion: radio sonar: the plugin ")
    assert "a_module_that_is_not_there" in said


@pytest.mark.usefixtures("broken_plugin")
def test_a_broken_plugin_that_is_not_chosen_does_no_harm(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["radio", "list"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert any(text.startswith("ndjson ") for text in said)
    assert said[-1].startswith("broken: radio sonar")


def test_a_recording_is_never_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "radio.jsonl"
    words = ["radio", "record", str(path), "--radio", "ndjson@/dev/ttyNOWHERE"]
    assert main(words) == 2
    assert not path.exists()
    path.write_text("precious")
    assert main(words) == 2
    assert path.read_text() == "precious"
    assert "exists already" in capsys.readouterr().err
