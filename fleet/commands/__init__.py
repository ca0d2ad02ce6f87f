"""Verbs of the `fleet` command, one per file."""
