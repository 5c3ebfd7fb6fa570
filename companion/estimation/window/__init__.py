"""Bounded-window MAP: the paper's objective over a thinned history, solved periodically."""
