"""Learning the measurement noise of the run: innovations."""
