"""What the process does beside flying: accounts, alarms, the watchdog, and surviving a restart."""
