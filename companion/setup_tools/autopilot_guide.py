"""Settings of an autopilot before its first flight under a companion.

Sources: the parameter references of PX4 1.15 and ArduCopter 4.5, docs/px4.md and docs/ardupilot.md.
`companion doctor` reads the values back and explains them.
"""

from __future__ import annotations

from companion.config.schema import CompanionConfig
from companion.io.links.transports import SerialPort, Transport

Setting = tuple[str, str, str]
"""Name, value, reason."""


def settings_to_make(autopilot: str, link: Transport, config: CompanionConfig) -> list[Setting]:
    """Return the parameters of one vehicle, in the order in which they are set."""
    baud = link.baud if isinstance(link, SerialPort) else None
    speed_mps = config.limits.speed_mps
    if autopilot == "px4":
        port: list[Setting] = [
            ("MAV_1_CONFIG", "102", "MAVLink on TELEM 2; restart, then the next two appear"),
            ("MAV_1_MODE", "2", "the streams of a companion (Onboard)"),
            ("SER_TEL2_BAUD", f"{baud}", "the speed of the serial port"),
        ]
        return [
            *(port if baud is not None else []),
            ("COM_OF_LOSS_T", "1.0", "seconds without setpoints that end OFFBOARD"),
            ("COM_OBL_RC_ACT", "5", "then Hold; 0 sinks where there is no transmitter"),
            ("GF_ACTION", "2", "PX4's own geofence holds, should all else fail"),
            ("MPC_XY_VEL_MAX", f"{speed_mps:g}", "m/s, or more: limits.speed_mps"),
        ]
    port = [
        ("SERIAL2_PROTOCOL", "2", "MAVLink 2 on TELEM 2"),
        ("SERIAL2_BAUD", f"{0 if baud is None else baud // 1000}", "the speed of the serial port"),
    ]
    return [
        *(port if baud is not None else []),
        ("FS_GCS_ENABLE", "1", "a lost ground station brings the vehicle home"),
        ("SYSID_MYGCS", "255", "the id of your ground station, never the vehicle's own"),
        ("FENCE_ENABLE", "1", "ArduPilot's own fence, should all else fail"),
        ("FENCE_ACTION", "4", "it brakes; 1 returns"),
        ("WPNAV_SPEED", f"{100.0 * speed_mps:g}", "cm/s, or more: limits.speed_mps"),
    ]


def guide(autopilot: str, link: Transport, config: CompanionConfig) -> list[str]:
    """Return the settings as lines for people."""
    name = {"px4": "PX4", "ardupilot": "ArduPilot"}[autopilot]
    rows = settings_to_make(autopilot, link, config)
    width = max(len(row[0]) for row in rows)
    return [
        f"set in {name} (QGroundControl or Mission Planner, Parameters):",
        *(f"  {key:<{width}}  {value:<6}  {why}" for key, value, why in rows),
    ]
