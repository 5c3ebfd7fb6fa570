"""Campaigns: many flights with faults, judged by the monitor, each replayable from its seed."""
