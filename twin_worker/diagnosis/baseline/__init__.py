"""Calibration of the baseline model, also from the aircraft's own past."""
