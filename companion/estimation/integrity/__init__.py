"""Integrity of the estimate: consistency, contradictions, motion of the target."""
