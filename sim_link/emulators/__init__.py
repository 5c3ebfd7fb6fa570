"""What real radios print, as the simulated one measures: the other end of `companion --radio`."""
