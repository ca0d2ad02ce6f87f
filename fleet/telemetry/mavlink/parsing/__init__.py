"""Compiled MAVLink parser: frames, checksums and payload fields of many datagrams at once."""
