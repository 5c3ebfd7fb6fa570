"""A second ground station: what it orders of the autopilot when an incident says so.

It speaks to the vehicle over a line of its own, so the companion hears its orders only by what the
autopilot shows of them; on a line that both share it hears the answers, too.
"""

from __future__ import annotations

import math
import struct

from companion.mav.codec import MavCodec
from companion.mav.dialect import Message, mavlink
from companion.mav.param_encoding import raw_value
from sim_link.autopilot.incidents import (
    StationFence,
    StationHome,
    StationParameter,
    StationRates,
    StationRecord,
)
from sim_link.autopilot.protocols.addressing import Channel
from sim_link.autopilot.protocols.message_streams import message_id
from sim_link.autopilot.vehicle import SimVehicle

IDS = (254, mavlink.MAV_COMP_ID_MISSIONPLANNER)
CHANNEL = Channel(0, ("other station", 0))
"""Link of its own; only this station receives the answers on it."""
E7 = 1e7
FENCE = mavlink.MAV_MISSION_TYPE_FENCE


def station_orders(incident: StationRecord, vehicle: SimVehicle) -> list[Message]:
    """Return the messages of the station, as the vehicle receives them, in order."""
    target = (vehicle.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1)
    orders: list[Message] = []
    match incident:
        case StationFence():
            orders = _fence(incident, vehicle, target)
        case StationParameter():
            orders = _parameter(incident, vehicle, target)
        case StationRates():
            interval_us = 1e6 / incident.rate_hz if incident.rate_hz > 0.0 else -1.0
            params = (float(message_id(incident.message)), interval_us, *[0.0] * 5)
            number = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
            orders = [mavlink.MAVLink_command_long_message(*target, number, 0, *params)]
        case StationHome():
            place = vehicle.estimator.world_origin.geodetic_from_enu(
                (incident.east_m, incident.north_m, incident.up_m)
            )
            what = (*target, mavlink.MAV_FRAME_GLOBAL, mavlink.MAV_CMD_DO_SET_HOME, 0, 0)
            nothing, at = (0.0, 0.0, 0.0, 0.0), (round(E7 * place[0]), round(E7 * place[1]))
            orders = [mavlink.MAVLink_command_int_message(*what, *nothing, *at, place[2])]
    codec = MavCodec(*IDS)
    received = (codec.decode_frame(codec.encode(order)) for order in orders)
    return [message for message in received if message is not None]


def _fence(incident: StationFence, vehicle: SimVehicle, target: tuple[int, int]) -> list[Message]:
    """Return an upload, or the clearing of the fence."""
    half_m = incident.half_side_m
    if half_m is None:
        return [mavlink.MAVLink_mission_clear_all_message(*target, FENCE)]
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [(half_m * east, half_m * north) for east, north in signs]
    command, first = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION, float(len(corners))
    if incident.is_circle:
        command, first = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_INCLUSION, half_m
        corners = [(0.0, 0.0)]
    command += 0 if incident.is_inclusion else 1
    messages: list[Message] = [mavlink.MAVLink_mission_count_message(*target, len(corners), FENCE)]
    for seq, (east_m, north_m) in enumerate(corners):
        place = (incident.east_m + east_m, incident.north_m + north_m, 0.0)
        latitude, longitude, _ = vehicle.estimator.world_origin.geodetic_from_enu(place)
        what = (*target, seq, mavlink.MAV_FRAME_GLOBAL, command, 0, 1, first, 0.0, 0.0, 0.0)
        at = (round(E7 * latitude), round(E7 * longitude), 0.0)
        messages.append(mavlink.MAVLink_mission_item_int_message(*what, *at, FENCE))
    return messages


def _parameter(
    incident: StationParameter, vehicle: SimVehicle, target: tuple[int, int]
) -> list[Message]:
    """Return a PARAM_SET; none of a parameter that the autopilot does not have."""
    store = vehicle.flavour.parameters
    index = store.index_of(incident.name)
    if index is None or not math.isfinite(incident.value):
        return []
    kind = store.specs[index].kind
    encoding = vehicle.flavour.firmware.parameters.encoding
    (value,) = struct.unpack("<f", raw_value(incident.value, kind, encoding))
    name = incident.name.encode("ascii")
    return [mavlink.MAVLink_param_set_message(*target, name, value, kind)]
