"""Blind test of the diagnosis: simulate, encrypt labels, diagnose, commit hashes, decrypt, score, report."""
