"""Predictions with the autopilot in the loop, and selection of the method."""
