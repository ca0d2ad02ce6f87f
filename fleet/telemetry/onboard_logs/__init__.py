"""Readers of onboard logs of autopilots."""
