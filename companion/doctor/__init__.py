"""`companion doctor`: is everything as a flight needs it, and if not, what mends it."""
