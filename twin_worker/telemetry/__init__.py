"""Telemetry of one aircraft: buffered, resampled, checked for what is missing."""
