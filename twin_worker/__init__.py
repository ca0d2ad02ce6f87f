"""Samples to judgement: identify, verify and predict each aircraft online."""
