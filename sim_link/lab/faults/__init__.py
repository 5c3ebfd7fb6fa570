"""Faults as values, and what applies them: to a flight in memory or to real processes."""
