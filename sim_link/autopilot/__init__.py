"""The simulated autopilot: modes, setpoints, streams and the MAVLink endpoint."""
