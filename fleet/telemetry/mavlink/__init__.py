"""Conversion of MAVLink frames to samples, status, mission and parameters of each aircraft."""
