"""Presence of the companion in ground stations, besides its parameters and texts.

Once a second a TARGET_ESTIMATE is sent for each emitter with an estimate, to an ArduPilot in a
TUNNEL as well, because it forwards only messages that it knows; and for the current emitter
NAMED_VALUE_FLOATs in metres, which Mission Planner and MAVProxy show and plot: degrees would be
rounded to half a metre as floats. While the searched area is counted, two of these report it: a
TARGET_ESTIMATE would need a position, and be drawn as a target.

On links of their own, and only if configured, ground stations get an ADSB_VEHICLE as well, which
they draw on their map. It never goes to the autopilot: one that avoids traffic would avoid the
emitter. A change of phase without any text is announced here.

Source: MAVLink common, NAMED_VALUE_FLOAT and ADSB_VEHICLE; `companion/mav/radio_ranging.xml`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

from companion.domain import Autopilot, EstimateState, TargetEstimate
from companion.geometry.coordinates import LocalOrigin
from companion.guidance.commands import Announce, Severity
from companion.guidance.phases import PHASE_NAMES
from companion.guidance.session import GuidanceSession
from companion.link import outbound
from companion.link.outbound import time_boot_ms
from companion.link.outlet import Outlet
from companion.mav.dialect import (
    INT32_UNKNOWN,
    MAVLink_target_estimate_message,
    Message,
    TargetState,
    mavlink,
    tunnelled,
)
from companion.search.searched_flight import GOOD_POD

PERIOD_S = 1.0
ICAO_BASE = 0xF00000
"""Base of an ICAO address that no aircraft has; the emitter's id is added."""
ICON_FLAGS = (
    mavlink.ADSB_FLAGS_VALID_COORDS
    | mavlink.ADSB_FLAGS_VALID_ALTITUDE
    | mavlink.ADSB_FLAGS_VALID_CALLSIGN
)
FLOAT32_MAX = (2.0 - 2.0**-23) * 2.0**127

AnyMessage = TypeVar("AnyMessage", bound=Message)


class Presence:
    """Periodic reports to ground stations; with `has_icon` also icons on `--gcs` links."""

    def __init__(self, session: GuidanceSession, outlet: Outlet, *, has_icon: bool) -> None:
        self._session = session
        self._outlet = outlet
        self._has_icon = has_icon
        self.next_s = -math.inf
        """Time of the next periodic reports."""
        self.phase = session.phase
        """Phase at the latest report."""

    def report(self, now_s: float, *, has_text: bool) -> None:
        """Announce a change of phase that had no text, and send the reports that are due."""
        phase = self._session.authority.phase
        if phase is not self.phase and not has_text:
            words = PHASE_NAMES.get(phase, phase.value)
            self._outlet.announce(Announce(Severity.INFO, words), now_s)
        self.phase = phase
        if now_s < self.next_s:
            return
        self.next_s = now_s + PERIOD_S
        if self._outlet.has_neighbour(now_s):
            name, own_id = outbound.MARK, float(self._outlet.own_ids[1])
            mark = mavlink.MAVLink_named_value_float_message(time_boot_ms(now_s), name, own_id)
            self._outlet.broadcast(mark, now_s, is_droppable=True)
        searching = self._session.searching
        if searching.is_counting and searching.is_worth_reporting and searching.state is not None:
            values = {
                b"SRCH_POS": searching.state.pos,
                b"SRCH_SHARE": searching.state.share_at(GOOD_POD),
            }
            for value in _floats(values, now_s):
                self._outlet.broadcast(value, now_s, is_droppable=True)
        self._send_estimates(now_s)

    def _send_estimates(self, now_s: float) -> None:
        origin = self._session.vehicle.origin
        for emitter in self._session.emitters(now_s):
            if emitter.estimate is None:
                continue
            message = estimate_message(emitter.emitter_id, emitter.estimate, origin, now_s)
            self._outlet.broadcast(message, now_s, is_droppable=True)
            if self._session.vehicle.autopilot is Autopilot.ARDUPILOT:
                self._outlet.send(tunnelled(message), now_s, is_droppable=True)
            if emitter.is_current:
                for value in named_values(emitter.estimate, now_s):
                    self._outlet.broadcast(value, now_s, is_droppable=True)
            is_localised = emitter.estimate.state is EstimateState.LOCALISED
            if self._has_icon and origin is not None and is_localised:  # one position to draw
                icon = icon_message(emitter.emitter_id, emitter.estimate, origin, now_s)
                self._outlet.send_to_stations(icon)


def estimate_message(
    emitter_id: int, estimate: TargetEstimate, origin: LocalOrigin | None, now_s: float
) -> MAVLink_target_estimate_message:
    """Return TARGET_ESTIMATE: ENU to north and east, counter-clockwise to clockwise."""
    latitude_e7, longitude_e7 = INT32_UNKNOWN, INT32_UNKNOWN
    if origin is not None:
        latitude_e7, longitude_e7, _ = _position_e7(estimate, origin)
    east_m, north_m = estimate.position_enu_m
    (var_east, cov_north_east), (_, var_north) = estimate.covariance_m2
    other = estimate.alternative_enu_m
    sigma_m = estimate.height_sigma_m
    message = MAVLink_target_estimate_message(
        time_boot_ms(now_s),
        latitude_e7,
        longitude_e7,
        north_m,
        east_m,
        var_north,
        cov_north_east,
        var_east,
        estimate.r95_m,
        math.nan if other is None else other[1],
        math.nan if other is None else other[0],
        estimate.height_m,
        math.nan if sigma_m is None else sigma_m,
        estimate.range_offset_m,
        -estimate.bearing_offset_rad,
        estimate.measurements,
        emitter_id,
        TargetState[estimate.state.name],
        estimate.absolute_r95_m,
        estimate.own.horizontal_m if estimate.own.is_reported else math.nan,
        estimate.own.vertical_m,
    )
    return _with_floats_that_fit(message)


def named_values(estimate: TargetEstimate, now_s: float) -> list[Message]:
    """Return NAMED_VALUE_FLOATs of an estimate, in metres from the local origin.

    With its covariance: a station behind PX4 gets nothing else, because PX4 1.16 forwards only
    messages that it knows.
    """
    east_m, north_m = estimate.position_enu_m
    (var_east, covariance), (_, var_north) = estimate.covariance_m2
    values = {b"TGT_EAST": east_m, b"TGT_NORTH": north_m, b"TGT_R95": estimate.r95_m}
    values[b"TGT_R95ABS"] = estimate.absolute_r95_m
    values |= {b"TGT_VAR_E": var_east, b"TGT_VAR_N": var_north, b"TGT_COV_EN": covariance}
    return _floats(values, now_s)


def _floats(values: Mapping[bytes, float], now_s: float) -> list[Message]:
    return [
        _with_floats_that_fit(
            mavlink.MAVLink_named_value_float_message(time_boot_ms(now_s), name, value)
        )
        for name, value in values.items()
    ]


def icon_message(
    emitter_id: int, estimate: TargetEstimate, origin: LocalOrigin, now_s: float
) -> Message:
    """Return ADSB_VEHICLE: a point obstacle whose call sign has emitter and absolute R95."""
    latitude_e7, longitude_e7, altitude_mm = _position_e7(estimate, origin)
    name = f"E{emitter_id % 1000}:{min(estimate.absolute_r95_m, 99.0):.0f}m"
    age_s = max(0.0, now_s - estimate.time_s)
    return mavlink.MAVLink_adsb_vehicle_message(
        ICAO_BASE + emitter_id,
        latitude_e7,
        longitude_e7,
        mavlink.ADSB_ALTITUDE_TYPE_GEOMETRIC,
        altitude_mm,
        0,
        0,
        0,
        name.encode("ascii"),
        mavlink.ADSB_EMITTER_TYPE_POINT_OBSTACLE,
        min(255, round(age_s)),
        ICON_FLAGS,
        0,
    )


def _with_floats_that_fit(message: AnyMessage) -> AnyMessage:
    """Return the message with floats clipped to float32: a diverging filter exceeds 3.4e38."""
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        if kind == "float" and abs(value := getattr(message, name)) > FLOAT32_MAX:
            setattr(message, name, math.copysign(FLOAT32_MAX, value))
    return message


def _position_e7(estimate: TargetEstimate, origin: LocalOrigin) -> tuple[int, int, int]:
    target_enu_m = (*estimate.position_enu_m, estimate.height_m)
    latitude_deg, longitude_deg, altitude_m = origin.geodetic_from_enu(target_enu_m)
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1e3)
