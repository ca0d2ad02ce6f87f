"""Numerical methods that know nothing of aircraft."""
