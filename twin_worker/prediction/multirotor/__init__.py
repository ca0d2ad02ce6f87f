"""Prediction of multirotors along their route."""
