"""Mismatch live: diagnose what an aircraft did lately, in the background, and predict with what was found."""
