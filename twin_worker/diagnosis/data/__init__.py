"""Recorded flight, aircraft card and fault hypotheses."""
