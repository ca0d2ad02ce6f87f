"""Endpoints: every kind of link to aircraft and ground stations, one per file."""
