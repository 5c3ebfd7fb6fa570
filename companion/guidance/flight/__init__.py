"""The vehicle, its fence, and the way from a plan to guarded setpoints."""
