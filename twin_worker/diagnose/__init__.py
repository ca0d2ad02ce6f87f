"""Diagnosis: where a flight and its simulation part ways, what physics was left out, and proof of it."""
