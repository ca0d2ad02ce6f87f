"""Replay of recordings over UDP, optionally as many aircraft."""
