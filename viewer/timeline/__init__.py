"""Time on the page: what was shown before, kept and shown again; what was predicted then against what happened."""
