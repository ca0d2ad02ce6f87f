"""Numerical methods independent of aircraft."""
