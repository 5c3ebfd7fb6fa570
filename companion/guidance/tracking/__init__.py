"""Tracking: ranging measurements in, estimates of one or more emitters out."""
