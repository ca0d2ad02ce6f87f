"""Validation of identified models on held-out data."""
