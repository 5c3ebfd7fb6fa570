"""What the process does beside flying: diagnostics, the watchdog, and surviving a restart."""
