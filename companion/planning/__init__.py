"""Planners: from an estimate to the next waypoint."""
