"""The simulated truth: vehicle, emitter and radio channel."""
