"""Predictions of a fleet in one wind field, with and without the shared estimate of that field."""
