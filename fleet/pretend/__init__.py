"""The pretend aircraft: JSBSim physics that speaks real MAVLink."""
