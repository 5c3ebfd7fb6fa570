"""Tasks of the process beside flying: diagnostics, the watchdog, and surviving a restart."""
