"""What a companion must do towards the vehicle that it serves."""
