"""Links to bus: MAVLink in, Samples out."""

import fleet  # noqa: F401  before numpy and numba: it holds BLAS to one thread and names the compile cache
