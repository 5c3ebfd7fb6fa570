"""Received powers that LoRa gateways and their servers report."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import pytest

from companion.radios.json_radios import LoraGatewayDecoder, LoraGatewayOptions, signal_dbm

DATA = base64.b64encode(b"\x40" + struct.pack("<I", 0x26011BDA) + bytes(8)).decode()
JOIN = base64.b64encode(b"\x00" + bytes(8) + bytes(range(8, 0, -1)) + bytes(6)).decode()
HEAD = b"\x02\x00\x0a\x00" + bytes.fromhex("AA555A0000000101")
HERE = {"gateway_ids": {"gateway_id": "here", "eui": "AA555A0000000101"}, "rssi": -60, "snr": 20}
THERE = {"gateway_ids": {"gateway_id": "there"}, "rssi": -90, "snr": 20}


def rxpk(**fields: Any) -> dict[str, Any]:
    return {"rxpk": [{"tmst": 2_500_000, "rssi": -60, "lsnr": 20.0, "data": DATA, **fields}]}


def read(*objects: Any, gateway: str = "") -> tuple[list[Any], list[str]]:
    decoder = LoraGatewayDecoder(LoraGatewayOptions(gateway=gateway))
    data = b"".join(HEAD + json.dumps(each).encode() for each in objects)
    readings = decoder.feed(data, 0.0)
    found = [(r.emitter, r.power_dbm and round(r.power_dbm, 1)) for r in readings]
    return found, [*decoder.counts.refused]


def test_a_signal_below_the_noise_is_weaker_than_the_channel() -> None:
    assert signal_dbm(-110.0, 30.0) == pytest.approx(-110.0, abs=0.01)
    assert signal_dbm(-110.0, 0.0) == pytest.approx(-113.01, abs=0.01)
    assert signal_dbm(-116.0, -20.0) == pytest.approx(-136.04, abs=0.01)
    assert signal_dbm(-110.0, None) == -110.0
    assert signal_dbm(0.0, 5.0) is None
    assert signal_dbm(None, 5.0) is None


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (rxpk(), ("26011BDA", -60.0)),
        (rxpk(rssis=-63), ("26011BDA", -63.0)),
        (rxpk(data=JOIN), ("0102030405060708", -60.0)),
        (rxpk(rssi=None, rsig=[{"rssic": -70, "lsnr": 20}, {"rssic": -65}]), ("26011BDA", -65.0)),
        ({"deviceInfo": {"devEui": "0a" * 8}, "rxInfo": [{"rssi": -57}]}, ("0a" * 8, -57.0)),
        ({"devEUI": "AgICAgICAgI=", "rxInfo": [{"rssi": -57, "loRaSNR": 0}]}, ("02" * 8, -60.0)),
        (
            {"end_device_ids": {"device_id": "tag"}, "uplink_message": {"rx_metadata": [HERE]}},
            ("tag", -60.0),
        ),
        (
            {
                "name": "as.up.data.forward",
                "data": {
                    "end_device_ids": {"dev_eui": "0A" * 8},
                    "uplink_message": {"rx_metadata": [HERE]},
                },
            },
            ("0A" * 8, -60.0),
        ),
    ],
)
def test_a_packet_has_its_device_and_the_power_of_its_signal(
    message: dict[str, Any], expected: tuple[str, float]
) -> None:
    assert read(message) == ([expected], [])


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (rxpk(stat=-1), "packet with a wrong checksum"),
        (rxpk(data="gA=="), "packet without a device"),
        (rxpk(data="not base64!"), "packet without a device"),
        (rxpk(rssi=0), "no power"),
        (rxpk(rssi="-60"), "no power"),
        (rxpk(rssi=True), "no power"),
        ({"rxInfo": [{"rssi": -57}]}, "packet without a device"),
        ({"uplink_message": {"rx_metadata": []}}, "not received by the gateway on the vehicle"),
        (
            {"end_device_ids": {}, "uplink_message": {"rx_metadata": [HERE, THERE]}},
            "several gateways: set gateway to the one on the vehicle",
        ),
    ],
)
def test_a_packet_that_cannot_be_used_is_refused_by_a_reason(
    message: dict[str, Any], reason: str
) -> None:
    assert read(message) == ([], [reason])


@pytest.mark.parametrize("gateway", ["there", "THERE"])
def test_of_several_gateways_the_one_on_the_vehicle_counts(gateway: str) -> None:
    message = {"end_device_ids": {"device_id": "tag"}}
    both = {**message, "uplink_message": {"rx_metadata": [HERE, THERE]}}
    other = {**message, "uplink_message": {"rx_metadata": [HERE]}}

    assert read(both, gateway=gateway) == ([("tag", -90.0)], [])
    assert read(other, gateway=gateway)[0] == []


def test_other_objects_are_passed_over_and_hide_nothing() -> None:
    assert read({"stat": {"rxnb": 2}}, {"a": '{"rxpk"'}, {"b": [{}]}, rxpk()) == (
        [("26011BDA", -60.0)],
        [],
    )
