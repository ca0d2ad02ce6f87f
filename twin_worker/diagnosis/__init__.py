"""Diagnosis of a flight: where simulation and recording differ, which physics is missing, and the evidence."""
