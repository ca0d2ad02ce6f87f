"""Predictions after a change of flight mode and after a link loss, beside those of undisturbed flight."""
