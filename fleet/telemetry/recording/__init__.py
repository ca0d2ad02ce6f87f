"""Readers of recordings: `.tlog` files, fleet logs, and what kind of recording a file is."""
