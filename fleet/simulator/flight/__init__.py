"""A simulated flight: autopilot in the loop, MAVLink streams, and the real-time driver."""
