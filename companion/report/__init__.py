"""The report of a flight: its page, its drawings, and the summary of its event log."""
