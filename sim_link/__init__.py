"""A MAVLink-speaking point-mass UAV with a radio payload, in place of an autopilot."""
