"""Identification of dynamics models from flight data."""
