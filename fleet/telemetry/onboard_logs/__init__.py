"""Readers of the logs that autopilots write on board."""
