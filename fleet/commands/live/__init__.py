"""Verbs of `fleet` that start, connect to or query running processes."""
