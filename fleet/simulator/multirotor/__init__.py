"""Simulated multirotors: RotorPy physics under an ArduCopter or a PX4 multirotor autopilot, with MAVLink interface."""
