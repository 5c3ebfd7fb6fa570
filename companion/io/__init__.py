"""Everything that touches the system: sockets, serial ports, clocks and files."""
