"""The wire: dialect, frames, codec and conversions; no sockets."""
