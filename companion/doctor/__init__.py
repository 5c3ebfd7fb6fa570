"""`companion doctor`: checks all that a flight needs, and gives a remedy for each fault."""
