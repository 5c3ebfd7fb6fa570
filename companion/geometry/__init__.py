"""Frames, plane vectors and polygons; pure functions."""
