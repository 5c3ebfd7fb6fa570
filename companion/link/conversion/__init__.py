"""Conversion of remote times and positions to ours: clocks by stamps, maps by pairs."""
