"""Identification measured: ours, the best public peers and the ceiling, on the same windows of the same flights."""
