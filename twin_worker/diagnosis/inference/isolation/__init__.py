"""Isolation of fault hypotheses in whitened residuals."""
