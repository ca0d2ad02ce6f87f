"""How the twin's physics is compiled: cached, reordered freely, and honest about nan: what is lost must be seen.

What makes no array is `bare`: nobody counts then who holds which, inside a loop half of the time.
"""

import numba as nb

_FREE = {"contract", "reassoc", "arcp", "afn", "nsz"}  # all of fastmath but the promise that nothing is nan or inf

kernel = nb.njit(cache=True, fastmath=_FREE, error_model="numpy", nogil=True)  # one thread learns, another predicts
bare = nb.njit(cache=True, fastmath=_FREE, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]
inlined = nb.njit(cache=True, fastmath=_FREE, error_model="numpy", inline="always")
