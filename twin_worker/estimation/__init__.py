"""Estimates of wind and of the airspeed set-point."""
