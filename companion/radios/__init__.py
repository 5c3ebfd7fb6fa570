"""Decoders for the formats of real radios, without sockets, clocks or files."""
