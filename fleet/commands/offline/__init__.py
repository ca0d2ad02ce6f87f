"""Verbs of `fleet` that work on files."""
