"""`companion replay`: runs recordings through the flight software again."""
