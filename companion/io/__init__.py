"""Shells: sockets, serial ports, clocks and files."""
