"""Telemetry of one aircraft: buffering, resampling and completeness check."""
