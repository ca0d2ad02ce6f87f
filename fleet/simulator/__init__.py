"""Simulated aircraft: JSBSim flight dynamics with a MAVLink interface."""
