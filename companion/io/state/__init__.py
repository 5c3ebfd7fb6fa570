"""State that outlives the process: checkpoints, the vehicle lock, and the memory of signing."""
