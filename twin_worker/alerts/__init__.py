"""Alerts derived from predictions: conflict, geofence, ground, feasibility."""
