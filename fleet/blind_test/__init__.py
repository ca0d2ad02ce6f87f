"""Blind test of the diagnosis: conceal, seal, diagnose, commit, open, score, report."""
