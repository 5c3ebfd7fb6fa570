"""PX4 1.15, multicopter, as observed in SITL."""
