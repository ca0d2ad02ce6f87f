"""How the twin's physics is compiled: cached, reordered freely, and honest about nan: what is lost must be seen."""

import numba as nb

_FREE = {"contract", "reassoc", "arcp", "afn", "nsz"}  # all of fastmath but the promise that nothing is nan or inf

kernel = nb.njit(cache=True, fastmath=_FREE, error_model="numpy", nogil=True)  # one thread learns, another predicts
inlined = nb.njit(cache=True, fastmath=_FREE, error_model="numpy", inline="always")
