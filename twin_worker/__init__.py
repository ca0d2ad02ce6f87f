"""Identify, verify and predict each aircraft online from its telemetry."""

import fleet  # noqa: F401  before numpy and numba: limits BLAS to one thread and sets the compile cache

CACHE_COMPLETE = "complete"  # file in the compile cache once it holds all functions
