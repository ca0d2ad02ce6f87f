"""Prediction of fixed-wing aircraft with the point-mass model, and its ensemble."""
