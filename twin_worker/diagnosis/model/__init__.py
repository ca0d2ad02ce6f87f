"""Simulation of the recorded flight under a baseline model, and its residuals."""
