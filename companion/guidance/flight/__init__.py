"""The vehicle, its fence, and the steps from a plan to guarded setpoints."""
