"""The sans-IO guidance session: events in, commands out."""
