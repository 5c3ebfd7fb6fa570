"""Between messages and events: the companion as a MAVLink endpoint."""
