"""Scores of predictions against what was flown."""
