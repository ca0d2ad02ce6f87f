"""Prediction regions and the confidence horizon by conformal prediction."""
