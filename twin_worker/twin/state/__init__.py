"""The state of one twin, its events and its schedule."""
