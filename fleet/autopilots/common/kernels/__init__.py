"""Small compiled functions of the control laws."""

from math import atan2, sqrt

import numba as nb

# no fastmath: nan means "no airspeed sensor"; nothing raises inside
array_kernel = nb.njit(cache=True, error_model="numpy", nogil=True)
# without arrays: reference counting took half of the run time
kernel = nb.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]


@nb.njit(cache=True, error_model="numpy", inline="always")
def hypot(x, y):  # type: ignore[no-untyped-def]
    """Return the length of a horizontal vector, without the overflow checks of `math.hypot`."""
    return sqrt(x * x + y * y)


@kernel
def clip(x: float, low: float, high: float) -> float:
    """Limit x; nan stays nan."""
    return low if x < low else (high if x > high else x)


@kernel
def angle_to(v_n: float, v_e: float, n: float, e: float) -> float:
    """Return the angle from one horizontal vector to another, right positive [rad]."""
    return atan2(v_n * e - v_e * n, v_n * n + v_e * e)
