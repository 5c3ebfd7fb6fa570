"""What POSITION_TARGET_LOCAL_NED and _GLOBAL_INT tell of the target that is flown.

The two autopilots tell it differently. PX4 shows what its position controller works with, in every
mode that has one: the place if there is one, and always the velocity and the acceleration that
follow from it, the yaw and the yaw rate; fields that mean nothing are NaN. ArduCopter shows the
target of GUIDED and nothing else; fields that mean nothing are 0, and yaw never means anything.

Source: PX4 `mavlink/streams/POSITION_TARGET_LOCAL_NED.hpp` and `mc_pos_control/PositionControl`;
ArduCopter `GCS_Mavlink.cpp`, `send_position_target_local_ned`.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.domain import PositionEnu
from companion.mav import type_mask

Axes = tuple[float | None, float | None, float | None]
"""East, north and up; None where nothing is asked."""
NOTHING: Axes = (None, None, None)
POSITION_BITS = (type_mask.Y_IGNORE, type_mask.X_IGNORE, type_mask.Z_IGNORE)
VELOCITY_BITS = (type_mask.VY_IGNORE, type_mask.VX_IGNORE, type_mask.VZ_IGNORE)
ACCELERATION_BITS = (type_mask.AY_IGNORE, type_mask.AX_IGNORE, type_mask.AZ_IGNORE)
"""Of east, north and up."""


@dataclass(frozen=True, slots=True)
class Echo:
    """One target."""

    place_enu_m: Axes = NOTHING
    """In the world's frame."""
    velocity_enu_mps: Axes = NOTHING
    acceleration_enu_mps2: Axes = NOTHING
    yaw_ned_rad: float | None = None
    yaw_rate_ned_radps: float | None = None
    """Clockwise positive."""
    nothing: float = 0.0
    """What a field holds that means nothing."""

    @property
    def type_mask(self) -> int:
        """POSITION_TARGET_TYPEMASK."""
        mask = 0 if self.yaw_ned_rad is not None else type_mask.YAW_IGNORE
        mask |= 0 if self.yaw_rate_ned_radps is not None else type_mask.YAW_RATE_IGNORE
        for axes, bits in (
            (self.place_enu_m, POSITION_BITS),
            (self.velocity_enu_mps, VELOCITY_BITS),
            (self.acceleration_enu_mps2, ACCELERATION_BITS),
        ):
            mask |= sum(bit for axis, bit in zip(axes, bits, strict=True) if axis is None)
        return mask

    @property
    def whole_place(self) -> PositionEnu | None:
        """The place, if all of it is asked for."""
        east, north, up = self.place_enu_m
        return None if east is None or north is None or up is None else (east, north, up)
