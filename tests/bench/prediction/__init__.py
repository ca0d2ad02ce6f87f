"""Prediction of every recording, beside the simple methods."""
