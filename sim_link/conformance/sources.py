"""Where rules come from that no document has."""

from __future__ import annotations

OBSERVED_PX4 = "PX4 1.15, observed in SITL"
OBSERVED_ARDUPILOT = "ArduCopter 4.5, observed in SITL"
