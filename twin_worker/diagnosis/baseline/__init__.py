"""Calibration of the baseline on nominal flights or on the first part of the same flight."""
