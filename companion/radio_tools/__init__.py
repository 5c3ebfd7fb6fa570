"""`companion radio`: list, watch, record and calibrate the radios of `companion.radios`.

The format of recordings is in `companion.io.radio_recording`, because replays need it, too.
"""
