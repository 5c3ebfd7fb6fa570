"""A companion-computer application that localises a radio emitter from a UAV."""

__version__ = "0.2.0"
