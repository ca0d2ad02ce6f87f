"""A blind examination of the diagnosis: conceal, seal, diagnose, commit, open, score, show."""
