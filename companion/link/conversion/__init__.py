"""Conversion of remote times and positions to local ones."""
