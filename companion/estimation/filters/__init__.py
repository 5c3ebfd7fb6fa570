"""Recursive filters: losses, update kernels, and the family of Kalman filters."""
