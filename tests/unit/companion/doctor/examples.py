"""Facts of a vehicle that is fit to fly, to be made worse by the tests."""

from __future__ import annotations

from companion.config.schema import DEFAULT_FENCE
from companion.doctor.findings import (
    AutopilotFacts,
    Facts,
    FolderFacts,
    HostFacts,
    LinkFacts,
    StreamRate,
)
from companion.domain import Autopilot, VehicleClass
from companion.geometry.coordinates import LocalOrigin
from companion.geometry.geofence import GeoArea, GeoFence
from companion.geometry.polygons import Corners
from companion.guidance.events import AutopilotFenceRead
from companion.guidance.readiness import REQUIREMENTS

ORIGIN = LocalOrigin(47.397742, 8.545594, 488.0)


def fence_about(origin: LocalOrigin, corners: Corners) -> GeoFence:
    """Return a fence as an autopilot reports it."""
    positions = (origin.geodetic_from_enu((east, north, 0.0))[:2] for east, north in corners)
    return GeoFence(GeoArea(tuple(positions)))


PX4_PARAMETERS: dict[str, float | None] = {
    "COM_OF_LOSS_T": 1.0,
    "COM_OBL_RC_ACT": 5,
    "COM_RC_OVERRIDE": 1,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "MPC_XY_VEL_MAX": 12.0,
}
ARDUPILOT_PARAMETERS: dict[str, float | None] = {
    "GUID_TIMEOUT": 3.0,
    "SYSID_MYGCS": 255,
    "FS_GCS_ENABLE": 1,
    "FS_GCS_TIMEOUT": 5.0,
    "FS_THR_ENABLE": 1,
    "FENCE_ENABLE": 1,
    "FENCE_ACTION": 1,
    "FENCE_TYPE": 7,
    "FENCE_RADIUS": 300.0,
    "FENCE_ALT_MAX": 100.0,
    "WPNAV_SPEED": 1000.0,
}
HOST = HostFacts(
    python=(3, 11, 7),
    numpy="2.0.0",
    can_compile_kernels=False,
    are_kernels_compiled=False,
    priority="real-time priority 1",
    logs=FolderFacts("flights", None, 20_000.0, 0.02),
    state=FolderFacts("/var/lib/companion", None, 20_000.0, 0.02),
    key_problem=None,
    has_key=True,
    unix_s=1.8e9,
    is_clock_synchronised=True,
)
PX4 = AutopilotFacts(
    autopilot=Autopilot.PX4,
    vehicle_class=VehicleClass.MULTICOPTER,
    system_id=1,
    component_id=1,
    mode="hold",
    is_armed=False,
    rates=(StreamRate("HEARTBEAT", 1.0, 5, 5.0), StreamRate("LOCAL_POSITION_NED", 20.0, 100, 5.0)),
    parameters=PX4_PARAMETERS,
    has_rc=True,
    heard=frozenset(row.message for row in REQUIREMENTS),
    origin=ORIGIN,
    estimator_flags=831,
    gps_fix=3,
    battery_pct=95,
    round_trip_s=0.002,
    clock_offset_s=-12.5,
    loss=0.0,
    fence=AutopilotFenceRead(0.0, fence_about(ORIGIN, DEFAULT_FENCE)),
)
LINK = LinkFacts(
    name="udp 127.0.0.1:14550",
    waited_s=8.0,
    autopilot=PX4,
    other_autopilots=(),
    other_companions=(),
    non_autopilots=(),
    bytes_received=50_000,
    bad_frames=0,
    unproved_frames=0,
)
FIT = Facts(HOST, LINK)
