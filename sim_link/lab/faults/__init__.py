"""Faults as values, and their application to flights in memory or to real processes."""
