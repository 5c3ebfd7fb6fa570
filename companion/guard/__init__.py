"""The only way to the wire for a setpoint: fence and envelope."""
