"""MAVLink's microservices as small state machines: messages and time in, messages out.

They know no vehicle, socket or clock. Actions for the vehicle are returned as values, and its
results are passed in as values.
"""
