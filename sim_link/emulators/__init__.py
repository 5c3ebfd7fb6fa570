"""Emulators of real radios' output formats: the other end of `companion --radio`."""
