"""Coordinates, polygons, free space and ways through it; pure functions."""
