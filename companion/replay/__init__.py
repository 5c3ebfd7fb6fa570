"""`companion replay`: what was recorded, through the flying code once more."""
