"""Validation of a fault hypothesis on data it was not fitted to."""
