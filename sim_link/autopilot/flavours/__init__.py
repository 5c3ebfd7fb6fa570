"""The autopilots that are simulated: what PX4 and ArduPilot do differently with one aircraft."""
