"""Operator page in the browser: positions, predictions and alerts of the fleet."""

import fleet  # noqa: F401  before numpy and numba: it limits BLAS to one thread and sets the compile cache
