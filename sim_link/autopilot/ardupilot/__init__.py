"""ArduCopter 4.5, as observed in SITL."""
