"""`companion doctor`: is everything as a flight needs it, and if not, the remedy."""
