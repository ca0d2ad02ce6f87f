"""Experiments of Huang et al. 2021, repeated."""
