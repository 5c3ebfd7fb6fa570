"""What a configuration may say about the vehicle and its link."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.params import Params


class VehicleParams(Params, frozen=True):
    """Which autopilot, and how it is commanded."""

    system_id: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None
    """The autopilot's system id; null: the first one heard."""
    setpoint: Literal["local_ned", "global_int"] = "local_ned"
    """SET_POSITION_TARGET_LOCAL_NED, or _GLOBAL_INT in frame 5 (AMSL)."""
