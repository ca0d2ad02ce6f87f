"""Gateway from MAVLink links to the bus: MAVLink in, Samples out."""

import fleet  # noqa: F401  before numpy and numba: it limits BLAS to one thread and sets the compile cache

DEFAULT_BUDGET = "1M"  # default rate that the aircraft of one link may send together [bytes/s]
