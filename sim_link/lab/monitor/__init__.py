"""Invariants of every frame and every step, judged from the wire and the truth alone."""
