"""Replay of recordings over UDP, also as many aircraft at once."""
