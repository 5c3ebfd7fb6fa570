"""MAVLink's microservices as small state machines: messages and time in, messages out.

Nothing here knows a vehicle, a socket or a clock. What a vehicle must do about a message comes out
as a value; what it has to say goes in as one.
"""
