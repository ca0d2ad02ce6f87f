"""Simpler prediction methods to compare with."""
