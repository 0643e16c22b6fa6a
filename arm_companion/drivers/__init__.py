"""What owns a device or a peer: servo bus, autopilot, our MAVLink component."""
