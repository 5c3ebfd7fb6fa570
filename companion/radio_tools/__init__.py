"""`companion radio`: list, watch, record and calibrate the radios of `companion.radios`.

What a recording is, is below in `companion.io.logs.radio_recording`, where replays find it, too.
"""
