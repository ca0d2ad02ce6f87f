"""Predictions with the autopilot in the loop, and the choice between methods."""
