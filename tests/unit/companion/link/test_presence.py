"""Messages to ground stations about the estimate and its links, and texts about phases."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.config.schema import CompanionConfig
from companion.domain import EstimateState, PositionAccuracy, TargetEstimate
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.phases import Trigger
from companion.link.interface import LinkParams
from companion.link.presence import FLOAT32_MAX, estimate_message, icon_message, named_values
from companion.mav.codec import MavCodec
from companion.mav.dialect import (
    MAVLink_radio_ranging_message,
    MAVLink_target_estimate_message,
    Message,
    mavlink,
)
from tests.unit.companion.link.wire import (
    ARDUPILOT,
    HOLD,
    OFFBOARD,
    PX4,
    Wire,
    heartbeat,
    local_position,
)

ORIGIN = LocalOrigin(47.0, 8.0, 488.0)
ESTIMATE = TargetEstimate(
    time_s=8.0,
    state=EstimateState.LOCALISED,
    position_enu_m=(30.0, -40.0),
    covariance_m2=((4.0, 0.5), (0.5, 9.0)),
    r95_m=6.4,
    range_offset_m=12.0,
    bearing_offset_rad=0.1,
    measurements=55,
    alternative_enu_m=(1.0, 2.0),
    height_m=3.0,
    height_sigma_m=1.5,
    own=PositionAccuracy(1.5, 2.5, is_reported=True),
    absolute_r95_m=7.5,
)
Estimate = MAVLink_target_estimate_message
Icon = mavlink.MAVLink_adsb_vehicle_message
NamedValue = mavlink.MAVLink_named_value_float_message
Text = mavlink.MAVLink_statustext_message


def on_the_wire(message: Message) -> Any:
    (read,) = MavCodec(9, 9).decode(MavCodec(1, 191).encode(message))
    return read


def test_an_estimate_goes_north_and_east_clockwise_with_its_covariance() -> None:
    sent = on_the_wire(estimate_message(7, ESTIMATE, ORIGIN, 10.0))
    assert (sent.north, sent.east) == (-40.0, 30.0)
    assert (sent.var_north, sent.cov_north_east, sent.var_east) == (9.0, 0.5, 4.0)
    assert (sent.alt_north, sent.alt_east) == (2.0, 1.0)
    assert (sent.height, sent.height_std, sent.range_offset) == (3.0, 1.5, 12.0)
    assert sent.bearing_offset == pytest.approx(-0.1)
    assert sent.r95 == pytest.approx(6.4)
    assert (sent.absolute_r95, sent.own_std, sent.own_height_std) == (7.5, 1.5, 2.5)
    assert (sent.time_boot_ms, sent.emitter_id, sent.measurements) == (10_000, 7, 55)
    assert sent.state == 2
    position = ORIGIN.enu_from_geodetic(sent.lat / 1e7, sent.lon / 1e7, 491.0)
    assert position == pytest.approx((30.0, -40.0, 3.0), abs=0.02)


def test_what_is_not_known_is_said_so() -> None:
    vague = TargetEstimate(0.0, EstimateState.SEARCHING, (0.0, 0.0), ((1, 0), (0, 1)), 9, 0, 0, 1)
    sent = on_the_wire(estimate_message(7, vague, None, 0.0))
    assert sent.lat == sent.lon == 2**31 - 1
    assert math.isnan(sent.alt_north)
    assert math.isnan(sent.alt_east)
    assert math.isnan(sent.height_std)
    assert math.isnan(sent.own_std)
    assert sent.absolute_r95 == pytest.approx(math.hypot(9.0, 3.0 * 2.4477), abs=1e-3)


def test_values_are_local_metres_with_names_that_fit() -> None:
    sent = [on_the_wire(message) for message in named_values(ESTIMATE, 10.0)]
    values = {message.name: message.value for message in sent}
    radii = {"TGT_R95": pytest.approx(6.4), "TGT_R95ABS": 7.5}
    (var_east, covariance), (_, var_north) = ESTIMATE.covariance_m2
    spread = {"TGT_VAR_E": var_east, "TGT_VAR_N": var_north, "TGT_COV_EN": covariance}
    assert values == {"TGT_EAST": 30.0, "TGT_NORTH": -40.0, **radii, **spread}
    assert all(len(name) <= 10 for name in values)


def test_what_is_beyond_a_float32_is_sent_as_the_largest_one() -> None:
    huge = replace(
        ESTIMATE,
        covariance_m2=((1e39, -1e39), (-1e39, 1e40)),
        r95_m=1e39,
        absolute_r95_m=math.inf,
        height_sigma_m=None,
    )
    sent = on_the_wire(estimate_message(7, huge, ORIGIN, 10.0))
    assert (sent.var_north, sent.cov_north_east) == (FLOAT32_MAX, -FLOAT32_MAX)
    assert sent.r95 == sent.absolute_r95 == FLOAT32_MAX
    assert math.isnan(sent.height_std)
    values = {m.name: m.value for m in map(on_the_wire, named_values(huge, 10.0))}
    assert values["TGT_VAR_E"] == values["TGT_R95ABS"] == FLOAT32_MAX
    assert values["TGT_COV_EN"] == -FLOAT32_MAX
    assert values["TGT_EAST"] == 30.0


def test_an_icon_is_an_obstacle_with_a_name_that_fits() -> None:
    sent = on_the_wire(icon_message(1007, ESTIMATE, ORIGIN, 10.0))
    assert sent.callsign == "E7:8m"
    assert sent.emitter_type == mavlink.ADSB_EMITTER_TYPE_POINT_OBSTACLE
    assert sent.flags == 1 | 2 | 16
    assert (sent.tslc, sent.altitude) == (2, pytest.approx(491_000, abs=20))
    assert sent.lat == on_the_wire(estimate_message(7, ESTIMATE, ORIGIN, 10.0)).lat


def heard(
    config: CompanionConfig, ticks: int = 200, autopilot: int = PX4, h_acc_mm: int | None = None
) -> Wire:
    """Return the wire after ticks of 0.1 s in the air, about an emitter without errors."""
    wire = Wire(config, gcs_links=1).ready(is_armed=False)
    wire.say(local_position(round(1e3 * wire.now_s) + 50, -40.0, 55.0, -20.0, 0.0, 0.0, 0.0))
    wire.say(heartbeat(autopilot, is_armed=True, status=4))
    for tick in range(ticks):
        wire.wait(0.1)
        angle = 0.05 * tick
        east_m, north_m = 30.0 + 25.0 * math.cos(angle), -40.0 + 25.0 * math.sin(angle)
        stamp_ms = round(1e3 * wire.now_s)
        vn_mps, ve_mps = 12.5 * math.cos(angle), -12.5 * math.sin(angle)
        wire.say(local_position(stamp_ms, north_m, east_m, -20.0, vn_mps, ve_mps, 0.0))
        if tick % 5 == 0:
            wire.say(heartbeat(autopilot, HOLD, is_armed=True, status=4))
            if h_acc_mm is not None:
                fix = (1000 * stamp_ms, 3, 0, 0, 0, 0, 0, 0, 0, 9, 0, h_acc_mm)
                wire.say(mavlink.MAVLink_gps_raw_int_message(*fix))
        bearing = math.atan2(30.0 - east_m, -40.0 - north_m)
        range_m = math.hypot(25.0, 20.0)
        ranging = (1000 * stamp_ms, range_m, 1.0, bearing, 0.05, math.nan, math.nan, 7, 255, 0)
        wire.say(MAVLink_radio_ranging_message(*ranging))
    return wire


def sent_on(wire: Wire, link: int) -> list[Message]:
    reader = MavCodec(9, 9)
    return [m for c in wire.raw if c.link == link for m in reader.decode(c.data)]


def test_once_a_second_on_all_links_and_an_icon_on_those_of_stations_only() -> None:
    wire = heard(CompanionConfig(link=LinkParams(gcs_icon=True)))
    assert wire.endpoint.session.estimate is not None
    for link in (0, 1):
        sent = sent_on(wire, link)
        estimates = [m for m in sent if isinstance(m, Estimate)]
        assert 15 <= len(estimates) <= 21
        assert estimates[-1].north == pytest.approx(-40.0, abs=5.0)
        assert estimates[-1].east == pytest.approx(30.0, abs=5.0)
        names = [m.name for m in sent if isinstance(m, NamedValue)]
        assert set(names) == {
            "TGT_EAST",
            "TGT_NORTH",
            "TGT_R95",
            "TGT_R95ABS",
            "TGT_VAR_E",
            "TGT_VAR_N",
            "TGT_COV_EN",
        }
        assert len(names) == 7 * len(estimates)
    icons = [m for m in sent_on(wire, 1) if isinstance(m, Icon)]
    assert icons
    assert not [m for m in sent_on(wire, 0) if isinstance(m, Icon)]


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
def test_only_an_ardupilot_gets_estimates_in_tunnels_too(autopilot: int) -> None:
    wire = heard(CompanionConfig(), 60, autopilot)
    tunnels = [m for m in sent_on(wire, 0) if isinstance(m, mavlink.MAVLink_tunnel_message)]
    estimates = [m for m in sent_on(wire, 0) if isinstance(m, Estimate)]
    assert len(tunnels) == (len(estimates) if autopilot == ARDUPILOT else 0)
    assert not [m for m in sent_on(wire, 1) if isinstance(m, mavlink.MAVLink_tunnel_message)]


@pytest.mark.parametrize(("h_acc_mm", "sigma_m"), [(20, 0.02), (5000, 5.0), (0, 3.0), (None, 3.0)])
def test_the_absolute_radius_follows_the_receiver(h_acc_mm: int | None, sigma_m: float) -> None:
    sent = heard(CompanionConfig(), 100, h_acc_mm=h_acc_mm).of(Estimate)[-1]
    assert sent.own_std == pytest.approx(sigma_m) or not h_acc_mm
    assert math.isnan(sent.own_std) == (not h_acc_mm)
    effective_m = 1.5 * sigma_m if sigma_m == 5.0 else sigma_m  # without corrections
    round_m = math.hypot(sent.r95, 2.4477 * effective_m)
    assert sent.r95 < sent.absolute_r95 < 1.01 * round_m


def test_no_station_gets_an_icon_unless_configured() -> None:
    wire = heard(CompanionConfig(), ticks=60)
    assert wire.of(Estimate)
    assert not wire.of(Icon)


def test_every_change_of_the_phase_is_reported() -> None:
    wire = Wire().bound()
    texts = len(wire.of(Text))
    seen = [wire.endpoint.session.phase]

    def expect_text() -> None:
        nonlocal texts
        for _ in range(4):
            wire.say(wire.position())
            wire.wait(0.05)
        assert wire.endpoint.session.phase is not seen[-1]
        seen.append(wire.endpoint.session.phase)
        assert len(wire.of(Text)) > texts, seen
        texts = len(wire.of(Text))

    wire.ready()
    expect_text()
    for mode, is_armed in ((OFFBOARD, True), (HOLD, True), (HOLD, False)):
        wire.say(heartbeat(custom_mode=mode, is_armed=is_armed, status=4))
        if not is_armed:
            wire.say(heartbeat(custom_mode=mode, is_armed=False, status=3))
        expect_text()
    assert [phase.value for phase in seen[:4]] == ["waiting", "standby", "hold", "yield"]


def test_a_change_that_came_without_a_reason_is_reported_as_text() -> None:
    wire = Wire().ready()
    wire.endpoint.session.context.enter(Trigger.LAUNCH, wire.now_s)
    wire.wait(0.05)
    assert wire.journal.texts[-1] == "launching"
