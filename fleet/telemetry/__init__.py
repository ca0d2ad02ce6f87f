"""Conversion of bytes to samples, identical for live links and recordings."""
