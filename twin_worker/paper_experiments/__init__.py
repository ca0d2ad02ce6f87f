"""Reproduction of the experiments of Huang et al. 2021."""
