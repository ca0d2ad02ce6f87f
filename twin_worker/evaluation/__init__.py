"""Replay of recordings through the twins, every prediction scored against the flight."""
