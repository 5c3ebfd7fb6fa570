"""Control of the vehicle: phases, control authority, hand-over and the automatic take-off."""
