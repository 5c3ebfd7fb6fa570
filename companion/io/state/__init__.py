"""What outlives the process: checkpoints, the vehicle lock, and what signing remembers."""
