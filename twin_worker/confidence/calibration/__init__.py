"""Fit and evaluation of calibration tables from scored predictions."""
