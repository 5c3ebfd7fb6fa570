"""`companion replay`: recordings through the flying code once more."""
