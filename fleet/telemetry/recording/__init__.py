"""Readers of recordings: `.tlog` files, fleet logs, and detection of the kind of recording."""
