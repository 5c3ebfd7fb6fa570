"""Checks for authors of plugins. No flight uses them, and they need no pytest."""
