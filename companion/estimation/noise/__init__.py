"""Learning the measurement noise of the run: mixtures, adaptation, innovations."""
