"""A companion-computer application that localises a radio emitter from a UAV."""

__version__ = "1.0.0rc1"
