"""Computational experiments with changed plans, and proposals that avoid a predicted event."""
