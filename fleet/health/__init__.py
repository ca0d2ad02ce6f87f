"""Checks of `fleet doctor`: this machine, access to the bus, and the fleet behind it."""
