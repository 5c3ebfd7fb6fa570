"""Who flies: phases, control authority, hand-over and the automatic take-off."""
