"""The demonstration: the canonical search on the simulator, watched live."""
