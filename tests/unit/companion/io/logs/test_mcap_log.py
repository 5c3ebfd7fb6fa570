"""MCAP files as Foxglove's own reader sees them."""

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from companion.errors import ConfigError
from companion.guidance.commands import Severity
from companion.io.mcap_file import McapLog, read_mcap_flight
from companion.mav.codec import MavCodec
from companion.mav.dialect import mavlink

ESTIMATE = {
    "position_enu_m": (10.0, 20.0),
    "covariance_m2": ((4.0, 1.0), (1.0, 2.0)),
    "own_sigma_m": 3.0,
    "sensor_enu_m": (1.0, 2.0, 30.0),
    "nis": 1.5,
    "range_innovation": 7.0,
    "range_weight": 0.3,
}
ORIGIN = {
    "latitude_deg": 47.4,
    "longitude_deg": 8.5,
    "altitude_m": 488.0,
    "offset_enu_m": (0.0, 5.0, 0.0),
}


def messages(path: Path) -> dict[str, list[Any]]:
    """Decoded JSON, or bytes, by channel."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            is_json = channel.message_encoding == "json"
            value = json.loads(message.data) if is_json else message.data
            found.setdefault(channel.topic, []).append(value)
    return found


def test_an_estimate_is_a_place_poses_residuals_and_an_outline(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "f.mcap", 1.8e9, "{}")
    log.record("origin", ORIGIN, 0.5)
    log.record("estimate", ESTIMATE, 1.25)
    log.close(10.0)
    found = messages(tmp_path / "f.mcap")
    (fix,) = found["/estimate/fix"]
    assert fix["latitude"] == pytest.approx(47.4 + 15.0 / 111_180, abs=1e-6)
    on_earth = [13.0, 1.0, 0.0, 1.0, 11.0, 0.0, 0.0, 0.0, 0.0]
    assert fix["position_covariance"] == on_earth
    assert fix["timestamp"] == {"sec": 1_800_000_001, "nsec": 250_000_000}
    assert found["/vehicle/pose"][0]["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 30.0}
    assert found["/residual"] == [{"nis": 1.5, "range_innovation": 7.0, "range_weight": 0.3}]
    outline = json.loads(found["/estimate/ellipse"][0]["geojson"])
    assert outline["geometry"]["type"] == "Polygon"


def test_without_an_origin_there_is_no_place_on_the_globe(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "f.mcap", 0.0, "{}")
    log.record("estimate", ESTIMATE, 1.0)
    log.close(10.0)
    found = messages(tmp_path / "f.mcap")
    assert "/estimate/fix" not in found
    assert len(found["/estimate/pose"]) == 1


def test_texts_have_levels_and_channels_have_foxgloves_schemas(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "f.mcap", 0.0, "{}")
    log.text(Severity.WARNING, "careful", 1.0)
    log.close(10.0)
    (text,) = messages(tmp_path / "f.mcap")["/log"]
    assert (text["level"], text["message"]) == (3, "careful")
    with (tmp_path / "f.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    names = {schema.name for schema in summary.schemas.values()}
    assert {"foxglove.LocationFix", "foxglove.PoseInFrame", "foxglove.GeoJSON"} <= names


def test_signatures_and_keys_are_not_kept(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "f.mcap", 0.0, "{}")
    setup = mavlink.MAVLink_setup_signing_message(1, 1, b"k" * 32, 0)
    log.frame(MavCodec(255, 190).encode(setup), 1.0)
    log.frame(MavCodec(255, 190).encode(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)), 1.0)
    log.close(10.0)
    assert len(messages(tmp_path / "f.mcap")["/mavlink"]) == 1


def test_a_file_ends_at_its_cap(tmp_path: Path) -> None:
    log = McapLog(tmp_path / "f.mcap", 0.0, "{}", max_bytes=20_000)
    for number in range(2000):
        log.record("phase", {"number": number}, 0.1 * number)
    log.close(10.0)
    assert log.dropped > 0
    assert 0 < len(messages(tmp_path / "f.mcap")["/events"]) < 2000


@pytest.mark.parametrize("content", [b"", b"no MCAP", bytes(1000)])
def test_what_is_no_mcap_is_refused_in_words(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "f.mcap"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"f\.mcap: "):
        read_mcap_flight(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_mcap_flight(tmp_path / "nowhere.mcap")
