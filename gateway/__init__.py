"""Gateway from MAVLink links to the bus: MAVLink in, Samples out."""

import fleet  # noqa: F401  before numpy and numba: it limits BLAS to one thread and sets the compile cache
