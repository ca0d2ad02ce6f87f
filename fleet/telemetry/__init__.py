"""Bytes to Samples, the same for a live link and a recording."""
