"""The flight report: one self-contained HTML page made of a flight's event log."""
