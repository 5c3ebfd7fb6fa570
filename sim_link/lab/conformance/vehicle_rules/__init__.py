"""Rules for a vehicle; a module per MAVLink service."""
