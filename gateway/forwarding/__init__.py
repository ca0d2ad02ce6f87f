"""Forwarding of raw MAVLink between links."""
