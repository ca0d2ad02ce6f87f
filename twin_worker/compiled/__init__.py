"""Compiled loops that every prediction goes through: many small arrays cost more to call numpy on than to reckon."""
