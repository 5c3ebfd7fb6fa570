"""What a vehicle must do, section by section; a module per MAVLink service."""
