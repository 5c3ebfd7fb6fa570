"""The companion as a MAVLink endpoint, which converts between messages and events."""
