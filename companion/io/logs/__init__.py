"""The logs of a flight: tlog, events, inputs, MCAP, and the recorder that writes them all."""
