"""Samples to judgement: identify, verify and predict each aircraft online."""

import fleet  # noqa: F401  before numpy and numba: it holds BLAS to one thread and names the compile cache
