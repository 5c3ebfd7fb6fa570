"""Coordinates, polygons, free space and paths through it; pure functions."""
